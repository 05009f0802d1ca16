"""Cases of the spherical harmonics."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor
from torch.nn.functional import normalize

from bench.case import U32, Agreement, Case
from methods.kernels.dispatch import served
from methods.kernels.spherical import SIZES, shade, spherical_harmonics


def cases() -> list[Case]:
    """Harmonics of no, one and many directions; colours of all degrees, forward and backward."""
    return [*_harmonics(), *_shading()]


def _harmonics() -> list[Case]:
    kernel = Agreement(
        "spherical",
        served(__package__),
        "coefficients below 3, polynomials of at most 4 terms of size 4 with 3 products each: 48 u",
    )
    return [
        kernel.case(f"{count:,} directions", partial(_prepare, count), 48 * U32, items=items)
        for count, items in ((0, None), (1, None), (131, None), (1 << 17, 1 << 17))
    ]


def _prepare(count: int, device: str) -> Callable[[str], tuple[Tensor, ...]]:
    generator = torch.Generator().manual_seed(count)
    directions = normalize(torch.randn(count, 3, generator=generator), dim=-1).to(device)
    return lambda backend: (spherical_harmonics(directions, backend=backend),)


def _shading() -> list[Case]:
    forward = Agreement(
        "shade",
        served(__package__),
        "16 products of harmonics below 2, off by 48 u, and coefficients below 6, and their sum: "
        "16 (6 x 48 + 16 x 12) u",
    )
    backward = Agreement(
        "shade backward",
        served(__package__),
        "products of harmonics, off by 48 u, and gradients below 6: 6 x 50 u",
    )
    found = []
    for count in (0, 1, 131, 1 << 16):
        for size in SIZES if count == 131 else SIZES[-1:]:
            name, items = f"{count:,} colours of {size}", count if count > 131 else None
            found += [
                forward.case(name, partial(_colours, count, size), 7680 * U32, items=items),
                backward.case(name, partial(_gradients, count, size), 300 * U32, items=items),
            ]
    return found


def _given(count: int, size: int, device: str) -> tuple[Tensor, Tensor, Tensor]:
    """Coefficients, directions and the gradient of the colours; all below 6."""
    generator = torch.Generator().manual_seed(count)
    coefficients = torch.randn(count, size, 3, generator=generator).clamp(-6, 6)
    directions = normalize(torch.randn(count, 3, generator=generator), dim=-1)
    grad = torch.randn(count, 3, generator=generator).clamp(-6, 6)
    return coefficients.to(device), directions.to(device), grad.to(device)


def _colours(count: int, size: int, device: str) -> Callable[[str], tuple[Tensor, ...]]:
    coefficients, directions, _ = _given(count, size, device)
    return lambda backend: (shade(coefficients, directions, backend=backend),)


def _gradients(count: int, size: int, device: str) -> Callable[[str], tuple[Tensor, ...]]:
    coefficients, directions, grad = _given(count, size, device)

    def call(backend: str) -> tuple[Tensor, ...]:
        given = coefficients.detach().requires_grad_()
        return torch.autograd.grad(shade(given, directions, backend=backend), given, grad)

    return call

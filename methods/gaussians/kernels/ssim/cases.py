"""Cases of SSIM: agreement of the backends."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from bench.case import U32, Agreement, Case
from methods.gaussians.kernels.ssim import ssim
from methods.kernels.dispatch import served

SIZES = ((40, 33), (1, 1), (3, 20), (400, 400))


def cases() -> list[Case]:
    """Sizes from one pixel to larger than the window; noise, a noisy patch, equal, black."""
    forward = Agreement(
        "ssim",
        served(__package__),
        "means of numbers below 1 by 22 products; the variances they leave, off by 48 u, are above "
        "1 / 20 in noise: 960 u",
    )
    backward = Agreement(
        "ssim backward",
        served(__package__),
        "of the sum: means under the window of three slopes below 2 x 20, off as the similarity "
        "is: 3 x 40 x 960 u",
    )
    tolerance = 960 * U32
    found = []
    for height, width in SIZES:
        size, items = f"{width} x {height}", height * width if height == 400 else None
        inputs = height, width
        for kind, which in (("noise", items), ("patch", None), ("equal", None)):
            prepare = partial(_similarity, kind, *inputs)
            found.append(forward.case(f"{kind}, {size}", prepare, tolerance, items=which))
        for kind, which in (("noise", items), ("patch", None), ("black", None)):
            prepare = partial(_gradient, kind, *inputs)
            found.append(backward.case(f"{kind}, {size}", prepare, 120 * tolerance, items=which))
    return found


def _pictures(kind: str, height: int, width: int, device: str) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(height)
    one, other = torch.rand(2, height, width, 3, generator=generator).to(device)
    if kind == "black":
        one = torch.zeros_like(one)
    if kind == "patch":
        rows, columns = slice(height // 4, height // 2 + 1), slice(width // 5, width // 2 + 1)
        patch, other = other[rows, columns], one.clone()
        other[rows, columns] = patch
    return one, one if kind == "equal" else other


def _similarity(
    kind: str, height: int, width: int, device: str
) -> Callable[[str], tuple[Tensor, ...]]:
    one, other = _pictures(kind, height, width, device)
    return lambda backend: (ssim(one, other, backend=backend),)


def _gradient(
    kind: str, height: int, width: int, device: str
) -> Callable[[str], tuple[Tensor, ...]]:
    one, other = _pictures(kind, height, width, device)

    def call(backend: str) -> tuple[Tensor, ...]:
        given = one.clone().requires_grad_()
        (grad,) = torch.autograd.grad(ssim(given, other, backend=backend), given)
        return (grad * one.numel(),)

    return call

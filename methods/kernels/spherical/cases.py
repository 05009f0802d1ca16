"""Cases of the spherical harmonics."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor
from torch.nn.functional import normalize

from bench.case import U32, Agreement, Case
from methods.kernels.dispatch import served
from methods.kernels.spherical import spherical_harmonics


def cases() -> list[Case]:
    """No, one and many directions."""
    kernel = Agreement(
        "spherical",
        served("spherical"),
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

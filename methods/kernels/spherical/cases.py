"""Cases of the spherical harmonics."""

from __future__ import annotations

from functools import partial

import torch
from torch.nn.functional import normalize

from methods.kernels.case import U32, Case, Prepared
from methods.kernels.spherical import spherical_harmonics


def cases() -> list[Case]:
    """No, one and many directions."""
    return [
        Case("spherical", f"{count:,} directions", "fp32", count, partial(_prepare, count), timed)
        for count, timed in ((0, False), (1, False), (131, False), (1 << 17, True))
    ]


def _prepare(count: int, device: str) -> Prepared:
    generator = torch.Generator().manual_seed(count)
    directions = normalize(torch.randn(count, 3, generator=generator), dim=-1).to(device)
    # Coefficients below 3, polynomials of at most 4 terms of size 4 with 3 products each.
    return Prepared(
        lambda backend: (spherical_harmonics(directions, backend=backend),), 3 * 4 * 4 * U32
    )

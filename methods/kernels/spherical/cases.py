"""Cases of the spherical harmonics."""

from functools import partial

import torch
from torch.nn.functional import normalize

from bench.case import U32, Bound, Case, Given, Operation
from methods.kernels.dispatch import served
from methods.kernels.spherical import spherical_harmonics

HARMONICS = Operation(
    "spherical",
    served(__package__),
    lambda given, backend: (spherical_harmonics(given["directions"], backend=backend),),
    {
        "harmonics": Bound(
            "coefficients below 3, polynomials of at most 4 terms of size 4 with 3 products each: "
            "48 u",
            48 * U32,
        )
    },
)


def cases() -> list[Case]:
    """Harmonics of no, one and many directions."""
    found = []
    for count in (0, 1, 131, 1 << 17):
        make, items = partial(unit_directions, count), count if count > 131 else None
        found += HARMONICS.cases(f"{count:,} directions", make, items=items)
    return found


def unit_directions(count: int) -> Given:
    """Random `directions` [count, 3]."""
    generator = torch.Generator().manual_seed(count)
    return {"directions": normalize(torch.randn(count, 3, generator=generator), dim=-1)}

"""Cases of the sums of harmonics."""

from functools import partial

import torch
from torch.nn.functional import normalize

from bench.case import U32, Bound, Case, Given, Operation
from methods.kernels.dispatch import served
from methods.kernels.shade import SIZES, shade

SHADE = Operation(
    "shade",
    served(__package__),
    lambda given, backend: (shade(given["coefficients"], given["directions"], backend=backend),),
    {
        "colours": Bound(
            "C products of harmonics below 2, off by 48 u, and coefficients below 6, and their "
            "sum: C (6 x 48 + 12 C) u",
            lambda given: (size := given["coefficients"].shape[1]) * (288 + 12 * size) * U32,
        )
    },
    {
        "coefficients": Bound(
            "products of harmonics below 2, off by 48 u, and gradients below 1: 50 u", 50 * U32
        )
    },
)


def cases() -> list[Case]:
    """Colours of all degrees, of no, one and many directions, forward and backward."""
    found = []
    for count in (0, 1, 131, 1 << 16):
        items = count if count > 131 else None
        for size in SIZES if count == 131 else SIZES[-1:]:
            make = partial(_coloured, count, size)
            found += SHADE.cases(f"{count:,} colours of {size}", make, items=items)
    return found


def _coloured(count: int, size: int) -> Given:
    generator = torch.Generator().manual_seed(count + 1)
    coefficients = torch.randn(count, size, 3, generator=generator).clamp(-6, 6)
    generator = torch.Generator().manual_seed(count)
    directions = normalize(torch.randn(count, 3, generator=generator), dim=-1)
    return {"coefficients": coefficients, "directions": directions}

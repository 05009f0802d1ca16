"""Cases of the sums of harmonics."""

from torch.nn.functional import normalize

from bench.case import U32, Bound, Cases, Given, Operation, Random
from methods.kernels.dispatch import served
from methods.kernels.shade import SIZES, shade

SHADE = Operation(
    "shade",
    served(__package__),
    shade,
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


def cases() -> Cases:
    """Colours of all degrees, of no, one and many directions, forward and backward."""
    found = []
    for count in (0, 1, 131, 1 << 16):
        for size in SIZES if count == 131 else SIZES[-1:]:
            name = f"{count:,} colours of {size}"
            found += SHADE.cases(name, _coloured, count, size, items=count)
    return found


def _coloured(count: int, size: int) -> Given:
    coefficients = Random(count + 1).normal(count, size, 3).clamp(-6, 6)
    directions = normalize(Random(count).normal(count, 3), dim=-1)
    return {"coefficients": coefficients, "directions": directions}

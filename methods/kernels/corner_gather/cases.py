"""Cases of the corner features: agreement of backends, NaN."""

import math

import torch
from torch import Tensor

from bench.case import U32, Bound, Cases, Given, Operation, Random
from methods.kernels.corner_gather import CORNERS, OFFSETS, corner_gather
from methods.kernels.dispatch import served

VIEW = 1 << 17  # samples of one view, for which the throughput is measured

SIDE = 48  # voxels along the grid of the cases


def _summed(given: Given) -> Tensor:
    """The tolerance for the gradient of each row of the table."""
    rows = given["corners"][given["voxel"].long()].flatten().long()
    reads = torch.bincount(rows, minlength=len(given["table"])).double()
    return (6 * reads.sqrt() * (reads + 1) * U32)[:, None]


GATHER = Operation(
    "corner_gather",
    served(__package__),
    corner_gather,
    {
        "features": Bound(
            "8 products of numbers of at most 1, and their sum, by both: 2 x 8 x 9 u", 144 * U32
        )
    },
    {
        "table": Bound(
            "a number sums gradients of at most 1 over n reads; 2 n independent roundings of "
            "partial sums of at most n add up to 6 sqrt(n) of them but for one case in 10^8 "
            "(Higham, Mary 2019)",
            _summed,
        )
    },
)


def cases() -> Cases:
    """Few and many samples, wide and narrow tables, NaN."""
    found = []
    for count, channels in ((0, 32), (1, 32), (257, 1), (257, 27), (257, 32), (VIEW, 32)):
        name = f"{count:,} samples of {channels}"
        found += GATHER.cases(name, _given, count, channels, items=count)
    return [*found, *GATHER.cases("NaN", _with_nan)]


def _given(count: int, channels: int) -> Given:
    """No number is larger than 1; samples on neighbouring rays, ray by ray, half a voxel apart."""
    random = Random(count)
    voxel = torch.cartesian_prod(*[torch.arange(SIDE)] * 3)
    x, y, z = (voxel[:, None] + OFFSETS).unbind(dim=-1)
    steps = min(count, 2 * SIDE)
    rays = math.ceil(math.sqrt(count / max(steps, 1)))
    across = torch.linspace(0.1, 0.7, rays) * SIDE
    u, v = torch.meshgrid(across, across, indexing="ij")
    t = (0.5 * torch.arange(steps)).expand(rays, rays, steps)
    place = torch.stack((u[..., None] + 0.2 * t, v[..., None] + 0.1 * t, t), dim=-1)
    i, j, k = place.reshape(-1, 3)[:count].long().unbind(dim=1)
    return {
        "table": random.signed((SIDE + 1) ** 3, channels),
        "corners": ((x * (SIDE + 1) + y) * (SIDE + 1) + z).int(),
        "voxel": ((i * SIDE + j) * SIDE + k).int(),
        "weights": random.share(count, CORNERS),
    }


def _with_nan() -> Given:
    given = _given(700, 5)
    given["weights"][::7, 3] = math.nan
    return given

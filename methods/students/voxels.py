"""Sparse voxels of the unit cube: which ones exist, and the corners that they share."""

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn import functional

from bench.types import Rays, TwoTensors
from methods.instant_ngp.pixels import PixelBatches
from methods.kernels.corner_gather import OFFSETS
from methods.kernels.types import Occupancy
from methods.kernels.voxel_walk import Crossings, Voxels, walk

CHUNK_RAYS = 1 << 15  # rays that are traced together: bounds the memory


def corners_of(coordinates: Tensor) -> TwoTensors:
    """The corners of V voxels at `coordinates` [V, 3], from 0 to 2^20: [V, 8] int32, which vertices
    each has, and [C, 3] int32, the coordinates of all vertices, ordered by x, then y, then z."""
    offsets = OFFSETS.to(coordinates.device)
    x, y, z = (coordinates.long()[:, None] + offsets).unbind(dim=-1)  # [V, 8]
    keys, corners = torch.unique((x << 42) + (y << 21) + z, return_inverse=True)
    mask = (1 << 21) - 1
    vertices = torch.stack((keys >> 42, keys >> 21 & mask, keys & mask), dim=1)
    return corners.int(), vertices.int()


def occupied_voxels(occupancy: Occupancy, resolution: int) -> Tensor:
    """The voxels [V, 3] int32 of a grid of another resolution that overlap occupied cells, ordered
    by x, then y, then z."""
    cells = occupancy.cells[None].float()
    return functional.adaptive_max_pool3d(cells, resolution)[0].nonzero().int()


@torch.no_grad()
def largest_weights(
    voxels: Voxels,
    weigh: Callable[[Rays, Crossings], Tensor],
    batches: PixelBatches,
    rays: int,
    generator: torch.Generator,
    backend: str,
) -> Tensor:
    """The largest weight [V] that each voxel has in a pixel, over as many random training `rays`,
    at most one for each pixel. `weigh` returns the weights [S] of the voxels that rays cross."""
    largest = torch.zeros(len(voxels), device=voxels.coordinates.device)
    most = min(rays, len(batches))
    for first in range(0, most, CHUNK_RAYS):
        some, _ = batches.draw(min(CHUNK_RAYS, most - first), generator)
        crossings = walk(some, voxels, backend=backend)
        largest.scatter_reduce_(0, crossings.voxel.long(), weigh(some, crossings), "amax")
    return largest

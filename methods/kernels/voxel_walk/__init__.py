"""Walks rays through the voxels of a sparse grid, front to back.

The unit cube is divided into G^3 cells, some of which are voxels that hold something. A ray o + t d
crosses the plane k of an axis at t = (k / G - o) / d, computed from the integer k alone, so that
the exit from a voxel and the entry into its neighbour have exactly the same t. The cell of a ray is
determined by the planes that it has crossed, so that every backend finds the same segments.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import torch
from torch import Tensor

from bench.types import Rays, check_shape
from methods.kernels.dispatch import implementation
from methods.kernels.types import Intervals, check_rays, clearance, expect

BRICK = 8  # cells along the side of a brick

MAX_RESOLUTION = 2048  # maximum number of cells along a side; the map of its bricks takes 64 MiB


@dataclass(frozen=True, eq=False)
class Voxels:
    """The non-empty cells (voxels) of a grid of G^3 over the unit cube, with their numbers. A
    two-level tree with branching 8^3: a map of bricks of 8^3 cells, and the cells of the bricks
    that contain any voxel. Both hold int32 numbers, -1 for empty."""

    coordinates: Tensor  # [V, 3] integers from 0 to G - 1, distinct (x, y, z); row v is voxel v
    resolution: int  # G, a multiple of 8, at most `MAX_RESOLUTION`

    def __post_init__(self) -> None:
        coordinates, size = self.coordinates, self.resolution
        check_shape("coordinates", coordinates, None, 3)
        whole = 0 < size <= MAX_RESOLUTION and not size % BRICK
        multiple = f"a multiple of {BRICK} from {BRICK} to {MAX_RESOLUTION}"
        expect(whole, "resolution", multiple, size)
        if len(coordinates):
            low, high = (int(end) for end in torch.aminmax(coordinates))
            expect(0 <= low <= high < size, "coordinates", f"0 to {size - 1}", f"{low} to {high}")

    @cached_property
    def bricks(self) -> Tensor:
        """Row of `leaves` of each brick: [G/8, G/8, G/8]."""
        side = self.resolution // BRICK
        used = torch.zeros([side] * 3, dtype=torch.bool, device=self.coordinates.device)
        used[(self.coordinates.long() // BRICK).unbind(dim=1)] = True
        row = used.flatten().cumsum(dim=0).view_as(used) - 1
        return torch.where(used, row, -1).int()

    @cached_property
    def leaves(self) -> Tensor:
        """Voxel of each cell (x, y, z) of a brick, at (x * 8 + y) * 8 + z: [B, 512]."""
        coordinates, bricks = self.coordinates.long(), self.bricks
        row = bricks[(coordinates // BRICK).unbind(dim=1)].long()
        x, y, z = (coordinates % BRICK).unbind(dim=1)
        leaves = bricks.new_full((int(bricks.max()) + 1, BRICK**3), -1)
        number = torch.arange(len(row), dtype=torch.int32, device=row.device)
        leaves[row, (x * BRICK + y) * BRICK + z] = number
        return leaves

    def __len__(self) -> int:
        return len(self.coordinates)

    @cached_property
    def clearance(self) -> Tensor:
        """`types.clearance` of the bricks that are not empty: [G/8, G/8, G/8]."""
        return clearance(self.bricks >= 0)

    @cached_property
    def masks(self) -> Tensor:
        """Which cells of a brick are voxels: [B, 8] int64, one word per x, bit y * 8 + z. The masks
        of a brick are in one cache line, whereas its `leaves` are in 32."""
        bits = torch.arange(BRICK**2, device=self.leaves.device)
        used = (self.leaves.view(-1, BRICK, BRICK**2) >= 0).long()
        return used.bitwise_left_shift(bits).sum(dim=2)


@dataclass(frozen=True)
class Crossings(Intervals):
    """Parts of R rays inside voxels, ray by ray, front to back. `t` is the middle of each, `delta`
    its world length; see `Intervals`."""

    near: Tensor  # [S] t where the ray enters the voxel
    far: Tensor  # [S] t where it leaves; for touching voxels it equals `near` of the next one
    ray: Tensor  # [S] int32, the ray that a crossing belongs to
    voxel: Tensor  # [S] int32 row of `Voxels.coordinates`
    of_a_sample: ClassVar[Sequence[str]] = "t", "delta", "near", "far", "ray", "voxel"


def walk(rays: Rays, voxels: Voxels, *, backend: str = "auto") -> Crossings:
    """Find every voxel that each of R `rays` crosses with positive length. Not differentiable.

    A ray in a plane between cells belongs to the cells above it. A ray has no crossings if it
    misses the cube, is not finite, or has a direction that is zero or so short that t overflows.
    The rays are float32; for backend="reference" also of another type.
    """
    check_rays(rays)
    return implementation(__name__, backend, rays.origins.device).walk(rays, voxels)

"""Leaves of an octree with a density and spherical harmonics each (Yu et al. 2021, Section 3)."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property

import torch
from torch import Tensor

from methods.kernels.types import Occupancy
from methods.kernels.voxel_walk import BRICK, Voxels
from methods.plenoctree.kernels.voxel_light import Light

CELL = 4
"""Leaves along the side of a cell of the occupancy that selects the rays of a frame."""


class Octree:
    """Leaves of one size, constant inside: V of the G^3 cells of the unit cube.

    Two maps replace all levels of the octree above the leaves: one of bricks of 8^3 leaves, and one
    of the leaves of each brick. A look-up takes two steps instead of nine.

    Attributes:
        voxels: which cells are leaves.
        light: their density, of which only the positive part is used (ReLU), and their harmonics.
    """

    def __init__(self, voxels: Voxels, light: Light) -> None:
        self.voxels, self.light = voxels, light

    @cached_property
    def occupancy(self) -> Occupancy:
        """The cells of `CELL`^3 leaves that contain any."""
        return Occupancy.at(self.voxels.coordinates // CELL, self.voxels.resolution // CELL)

    def visible(self) -> Octree:
        """The octree without the leaves that show nothing: those whose density is not positive."""
        light, shown = self.light, self.light.density > 0
        voxels = Voxels(self.voxels.coordinates[shown], self.voxels.resolution)
        return Octree(voxels, Light(light.density[shown], light.harmonics[shown]))

    def rounded(self) -> Octree:
        """The visible leaves, rounded as in a file of 16-bit numbers."""
        light = self.light
        return Octree(self.voxels, Light(_half(light.density), _half(light.harmonics))).visible()

    def sizes(self, width: int) -> dict[str, int]:
        """Bytes of the values, `width` each, and of the index: a word for each brick of the cube;
        for each brick in use, a bit per leaf and the number of its first leaf."""
        values = self.light.density.numel() + self.light.harmonics.numel()
        bricks, used = self.voxels.bricks.numel(), len(self.voxels.leaves)
        return {"leaves": width * values, "index": 4 * bricks + used * (BRICK**3 // 8 + 4)}

    def tensors(self) -> dict[str, Tensor]:
        """Everything, for a file."""
        return {
            "coordinates": self.voxels.coordinates.to(torch.int16),
            "resolution": torch.tensor(self.voxels.resolution),
            "density": self.light.density.detach(),
            "harmonics": self.light.harmonics.detach(),
        }

    @classmethod
    def of(cls, tensors: Mapping[str, Tensor], device: torch.device) -> Octree:
        """Make an octree of what `tensors` returned."""
        coordinates, density, harmonics = (
            tensors[name].to(device) for name in ("coordinates", "density", "harmonics")
        )
        voxels = Voxels(coordinates.int(), int(tensors["resolution"]))
        return cls(voxels, Light(density.clone(), harmonics.clone()))


def _half(values: Tensor) -> Tensor:
    # Values beyond the range of float16 are just as opaque, or saturated, at its end.
    most = torch.finfo(torch.float16).max
    return values.clamp(-most, most).half().float()

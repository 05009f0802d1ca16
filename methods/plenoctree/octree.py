"""Leaves of an octree with a density and spherical harmonics each (Yu et al. 2021, Section 3)."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property

import torch
from torch import Tensor

from methods.kernels.march import Occupancy
from methods.kernels.voxel_walk import BRICK, Light, Voxels

CELL = 4
"""Leaves along the side of a cell of the occupancy with which a frame finds its rays."""


class Octree:
    """Leaves of one size, constant inside: V of the G^3 cells of the unit cube.

    All levels of the octree above the leaves are two maps: of bricks of 8^3 leaves, and of the
    leaves of each brick. It is read in two steps instead of nine.

    Attributes:
        voxels: which cells are leaves.
        light: their density, which is shown where it is positive (ReLU), and their harmonics.
    """

    def __init__(self, voxels: Voxels, light: Light) -> None:
        self.voxels, self.light = voxels, light

    @cached_property
    def occupancy(self) -> Occupancy:
        """The cells of `CELL`^3 leaves that have any."""
        return Occupancy.at(self.voxels.coordinates // CELL, self.voxels.resolution // CELL)

    def visible(self) -> Octree:
        """The same without the leaves that show nothing: those whose density is not positive."""
        light, shown = self.light, self.light.density > 0
        voxels = Voxels(self.voxels.coordinates[shown], self.voxels.resolution)
        return Octree(voxels, Light(light.density[shown], light.harmonics[shown]))

    def rounded(self) -> Octree:
        """The visible leaves as they come back from a file of 16-bit numbers."""
        light = self.light
        return Octree(self.voxels, Light(_half(light.density), _half(light.harmonics))).visible()

    def sizes(self, width: int) -> dict[str, int]:
        """Bytes of values of `width` bytes, and of what finds them: a word for each brick of the
        cube, and for each brick in use a bit a leaf and the number of its first leaf."""
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
        """What `tensors` gave."""
        coordinates, density, harmonics = (
            tensors[name].to(device) for name in ("coordinates", "density", "harmonics")
        )
        voxels = Voxels(coordinates.int(), int(tensors["resolution"]))
        return cls(voxels, Light(density.clone(), harmonics.clone()))


def _half(values: Tensor) -> Tensor:
    # What exceeds the range of float16 is opaque, or saturated, at its end, too.
    most = torch.finfo(torch.float16).max
    return values.clamp(-most, most).half().float()

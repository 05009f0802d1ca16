"""Leaves of an octree with a density and spherical harmonics each, and their extraction from a
trained field (Yu et al. 2021, Sections 3 and 4): which are needed, how dense they are, and their
colours."""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated, Self

import torch
from torch import Tensor

from bench.types import Rays, SteerbenchError
from methods.instant_ngp.pixels import PixelBatches
from methods.instant_ngp.stage1 import TrainedField
from methods.kernels.composite import STOP, visibility
from methods.kernels.settings import Checked, Count, Degree, NotNegative, multiple
from methods.kernels.spherical import spherical_harmonics
from methods.kernels.types import Occupancy, expect
from methods.kernels.voxel_walk import BRICK, Crossings, Voxels
from methods.plenoctree.kernels.voxel_light import Light
from methods.rendering.field import Field, pad
from methods.rendering.occupancy import LARGEST, RESOLUTION
from methods.students.voxels import largest_weights
from methods.training.checkpoint import Tensors

CELL = 4  # leaves along the side of a cell of the occupancy that selects the rays of a frame

QUERIES = 1 << 18  # points at which the field is evaluated together

CLAMP = 1e-3  # colours are clamped this far from 0 and 1, where their logits are infinite


@dataclass(frozen=True)
class Octree:
    """Leaves of one size: V of the G^3 cells of the unit cube. Only positive densities are used.
    Two maps, of bricks of 8^3 leaves and of the leaves of each brick, replace all levels above the
    leaves: a look-up takes two steps instead of nine."""

    voxels: Voxels
    light: Light

    @cached_property
    def occupancy(self) -> Occupancy:
        """The cells of `CELL`^3 leaves that contain any."""
        return Occupancy.at(self.voxels.coordinates // CELL, self.voxels.resolution // CELL)

    def visible(self, stored: str = "fp32") -> Self:
        """The leaves that show anything, those whose density is positive; with "fp16", rounded as
        in a file of 16-bit numbers."""
        density, harmonics = self.light.density, self.light.harmonics
        if stored == "fp16":
            density, harmonics = _half(density), _half(harmonics)
        shown = density > 0
        voxels = Voxels(self.voxels.coordinates[shown], self.voxels.resolution)
        return replace(self, voxels=voxels, light=Light(density[shown], harmonics[shown]))

    def sizes(self, width: int) -> dict[str, int]:
        """Bytes of the values, `width` each, and of the index: a word for each brick of the cube;
        for each brick in use, a bit per leaf and the number of its first leaf."""
        values = self.light.density.numel() + self.light.harmonics.numel()
        bricks, used = self.voxels.bricks.numel(), len(self.voxels.leaves)
        return {"leaves": width * values, "index": 4 * bricks + used * (BRICK**3 // 8 + 4)}

    def tensors(self) -> Tensors:
        """Everything, for a file."""
        return {
            "coordinates": self.voxels.coordinates.to(torch.int16),
            "resolution": torch.tensor(self.voxels.resolution),
            "density": self.light.density.detach(),
            "harmonics": self.light.harmonics.detach(),
        }

    @classmethod
    def of(cls, tensors: Tensors, device: torch.device) -> Self:
        """Make an octree of what `tensors` returned."""
        density, harmonics = (tensors[x].to(device, copy=True) for x in ("density", "harmonics"))
        coordinates = tensors["coordinates"].to(device).int()
        return cls(Voxels(coordinates, int(tensors["resolution"])), Light(density, harmonics))


def _half(values: Tensor) -> Tensor:
    # Values beyond the range of float16 are just as opaque, or saturated, at its end.
    most = torch.finfo(torch.float16).max
    return values.clamp(-most, most).half().float()


@dataclass(frozen=True)
class Extraction(Checked):
    """How leaves are found and filled, as `sweeps/configs/method/plenoctree.yaml` explains."""

    resolution: Annotated[int, multiple(RESOLUTION, 2048)]
    degree: Degree
    least_weight: NotNegative
    rays: Count
    points: Count
    directions: int
    most_leaves: Count

    def __post_init__(self) -> None:
        super().__post_init__()
        terms = (self.degree + 1) ** 2
        needed = f"at least {terms}, as many as degree {self.degree} has harmonics"
        expect(self.directions >= terms, "directions", needed, self.directions)


@torch.no_grad()
def extract(
    teacher: TrainedField, batches: PixelBatches, options: Extraction, generator: torch.Generator
) -> Octree:
    """Extract the octree of what `trained` shows to the training rays of `batches`; raise
    SteerbenchError if there are too many candidates, or if nothing is to be seen."""
    field, resolution, backend = teacher.field, options.resolution, teacher.field.backend
    voxels = Voxels(_candidates(teacher.occupancy, options), resolution)
    density = _densities(field, voxels, options.points, generator)

    def weigh(_: Rays, crossings: Crossings) -> Tensor:
        sigma = density[crossings.voxel]
        return visibility(sigma, crossings, stop=STOP, backend=backend).weights

    seen = largest_weights(voxels, weigh, batches, options.rays, generator, backend)
    kept = (seen >= options.least_weight) & (density > 0)
    if not kept.any():
        none = f"octree: no leaf has a weight of {options.least_weight} on a training ray"
        raise SteerbenchError(f"{none}: expected a trained field; give it more budget.steps")
    voxels = Voxels(voxels.coordinates[kept], resolution)
    harmonics = _harmonics(field, voxels, options.degree, options.directions)
    return Octree(voxels, Light(density[kept], harmonics))


def _candidates(occupancy: Occupancy, options: Extraction) -> Tensor:
    """The leaves [V, 3] int32 inside occupied cells."""
    size, cells = options.resolution, occupancy.cells.nonzero().int()
    wide = size // occupancy.resolution
    count = len(cells) * wide**3
    if count > options.most_leaves:
        raise SteerbenchError(
            f"octree: {count:,} leaves of {size}^3 lie in occupied cells, expected at most "
            f"{options.most_leaves:,}: choose a smaller method.extraction.resolution, or a larger "
            "most_leaves where there is the memory for them (about 500 bytes each)"
        )
    side = torch.arange(wide, dtype=torch.int32, device=cells.device)
    inner = torch.cartesian_prod(side, side, side).view(-1, 3)
    return (cells[:, None] * wide + inner).reshape(-1, 3)


def _densities(field: Field, leaves: Voxels, points: int, generator: torch.Generator) -> Tensor:
    """Mean density [V] over random `points` of each leaf (Section 3.2: anti-aliasing)."""
    found = []
    for part in leaves.coordinates.split(QUERIES):
        total = torch.zeros(len(part), device=part.device)
        for _ in range(points):
            jitter = torch.rand(part.shape, generator=generator, device=part.device)
            places = (part + jitter) / leaves.resolution
            total += field.density(pad(places))[0][: len(part)].clamp(max=LARGEST)
        found.append(total / points)
    return torch.cat(found)


def _harmonics(field: Field, voxels: Voxels, degree: int, directions: int) -> Tensor:
    """Coefficients [V, C, 3], fitted by least squares to the logits of the colours at the centres
    of the voxels, in `directions` evenly spread directions."""
    towards = fibonacci_sphere(directions).to(voxels.coordinates.device)
    basis = spherical_harmonics(towards)[:, : (degree + 1) ** 2].double()
    solve = torch.linalg.pinv(basis).float()  # [C, D], the same for all voxels
    encoded = field.encode_directions(towards)
    found = []
    for part in voxels.coordinates.split(max(QUERIES // directions, 1)):
        count = len(part)
        _, geometry = field.density(pad((part + 0.5) / voxels.resolution))
        pairs = geometry[:count].repeat_interleave(directions, dim=0)
        shown = field.features(pad(pairs), pad(encoded.repeat(count, 1)))[: len(pairs), :3]
        logits = shown.clamp(CLAMP, 1 - CLAMP).logit().view(count, directions, 3)
        found.append(torch.einsum("cd,vdk->vck", solve, logits))
    return torch.cat(found)


def fibonacci_sphere(count: int) -> Tensor:
    """Unit vectors [count, 3], evenly spread: a golden angle for each equal step in height."""
    i = torch.arange(count, dtype=torch.float64)
    z = 1 - (2 * i + 1) / count
    angle = i * math.pi * (3 - math.sqrt(5))
    radius = (1 - z * z).sqrt()
    return torch.stack((radius * angle.cos(), radius * angle.sin(), z), dim=1).float()

"""Extraction of an octree from a trained field (Yu et al. 2021, Sections 3.2 and 4): which leaves
are needed, how dense they are, and spherical harmonics for their colours."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from bench.types import Rays, SteerbenchError
from methods.instant_ngp.pixels import PixelBatches
from methods.instant_ngp.stage1 import TrainedField
from methods.kernels.composite import STOP, weights
from methods.kernels.spherical import spherical_harmonics
from methods.kernels.types import Occupancy, expect
from methods.kernels.voxel_walk import BRICK, Crossings, Voxels
from methods.plenoctree.kernels.voxel_light import Light
from methods.plenoctree.octree import Octree
from methods.rendering.field import Field, pad
from methods.students.voxels import largest_weights

QUERIES = 1 << 18
"""Points at which the field is evaluated together."""

CLAMP = 1e-3
"""Colours are clamped this far from 0 and 1, where their logits are infinite."""


@dataclass(frozen=True)
class Extraction:
    """How leaves are found and filled.

    Attributes:
        resolution: leaves along the side of the cube, a multiple of 64, 128 to 2048.
        degree: degree of the spherical harmonics, 0 to 3.
        least_weight: a leaf is kept if its weight on any of the training rays is at least this.
        rays: random training rays that are traced, at most as many as there are.
        points: random points of a leaf over which its density is averaged.
        directions: number of directions in which its colour is evaluated.
        most_leaves: maximum number of candidates; more are refused before memory is allocated.
    """

    resolution: int = 512
    degree: int = 2
    least_weight: float = 1e-3
    rays: int = 1 << 22
    points: int = 8
    directions: int = 64
    most_leaves: int = 12_000_000

    def __post_init__(self) -> None:
        size, terms = self.resolution, (self.degree + 1) ** 2
        whole = 128 <= size <= 2048 and not size % BRICK**2
        expect(whole, "resolution", f"a multiple of {BRICK**2} from 128 to 2048", size)
        expect(self.degree in range(4), "degree", "0 to 3", self.degree)
        needed = f"at least {terms}, as many as degree {self.degree} has harmonics"
        expect(self.directions >= terms, "directions", needed, self.directions)
        for name in ("rays", "points", "most_leaves"):
            expect(getattr(self, name) >= 1, name, "1 or more", getattr(self, name))
        expect(self.least_weight >= 0, "least_weight", "0 or more", self.least_weight)


@torch.no_grad()
def extract(
    trained: TrainedField,
    batches: PixelBatches,
    options: Extraction,
    generator: torch.Generator,
) -> Octree:
    """Extract the octree of what `trained` shows to the training rays of `batches`.

    Raises:
        SteerbenchError: there are more candidates than allowed, or nothing to be seen.
    """
    candidates = _candidates(trained.occupancy, options)
    density = _densities(trained.field, candidates, options.resolution, options.points, generator)
    voxels, backend = Voxels(candidates, options.resolution), trained.field.backend

    def weigh(_: Rays, crossings: Crossings) -> Tensor:
        return weights(density[crossings.voxel], crossings, stop=STOP, backend=backend)

    seen = largest_weights(voxels, weigh, batches, options.rays, generator, backend)
    kept = (seen >= options.least_weight) & (density > 0)
    if not kept.any():
        raise SteerbenchError(
            f"octree: no leaf has a weight of {options.least_weight} on a training ray: expected "
            "a trained field; give it more steps (budget.steps)"
        )
    voxels = Voxels(candidates[kept], options.resolution)
    harmonics = _harmonics(trained.field, voxels, options.degree, options.directions)
    return Octree(voxels, Light(density[kept], harmonics))


def _candidates(occupancy: Occupancy, options: Extraction) -> Tensor:
    """The leaves [V, 3] int32 inside occupied cells."""
    size, cells = options.resolution, occupancy.cells.nonzero().int()
    wide = size / occupancy.resolution
    count = round(len(cells) * wide**3)
    if count > options.most_leaves:
        raise SteerbenchError(
            f"octree: {count:,} leaves of {size}^3 lie in occupied cells, expected at most "
            f"{options.most_leaves:,}: choose a smaller method.extraction.resolution, or a larger "
            "most_leaves where there is the memory for them (about 500 bytes each)"
        )
    of_field = f"a multiple of {occupancy.resolution}, that of the field's occupancy"
    expect(wide.is_integer(), "resolution", of_field, size)
    side = torch.arange(int(wide), dtype=torch.int32, device=cells.device)
    inner = torch.cartesian_prod(side, side, side).view(-1, 3)
    return (cells[:, None] * int(wide) + inner).reshape(-1, 3)


def _densities(
    field: Field, leaves: Tensor, resolution: int, points: int, generator: torch.Generator
) -> Tensor:
    """Mean density [V] over random `points` of each leaf (Section 3.2: anti-aliasing)."""
    found = []
    for part in leaves.split(QUERIES):
        total = torch.zeros(len(part), device=part.device)
        for _ in range(points):
            jitter = torch.rand(part.shape, generator=generator, device=part.device)
            total += field.density(pad((part + jitter) / resolution))[0][: len(part)]
        found.append(total / points)
    return torch.cat(found)


def _harmonics(field: Field, voxels: Voxels, degree: int, directions: int) -> Tensor:
    """Coefficients [V, C, 3], fitted by least squares to the logits of the colours at the centres
    of the voxels, in `directions` evenly spread directions."""
    device, terms = voxels.coordinates.device, (degree + 1) ** 2
    towards = fibonacci_sphere(directions).to(device)
    basis = spherical_harmonics(towards, backend=field.backend)[:, :terms].double()
    solve = torch.linalg.pinv(basis).float()  # [C, D], the same for all voxels
    encoded = field.encode_directions(towards)
    found = torch.zeros(len(voxels), terms, 3, device=device)
    batch = max(QUERIES // directions, 1)
    for first in range(0, len(voxels), batch):
        centres = (voxels.coordinates[first : first + batch] + 0.5) / voxels.resolution
        count = len(centres)
        _, geometry = field.density(pad(centres))
        pairs = geometry[:count].repeat_interleave(directions, dim=0)
        shown = field.features(pad(pairs), pad(encoded.repeat(count, 1)))[: len(pairs), :3]
        logits = shown.clamp(CLAMP, 1 - CLAMP).logit().view(count, directions, 3)
        found[first : first + batch] = torch.einsum("cd,vdk->vck", solve, logits)
    return found


def fibonacci_sphere(count: int) -> Tensor:
    """Unit vectors [count, 3], evenly spread: a turn of the golden angle for each equal step in
    height."""
    i = torch.arange(count, dtype=torch.float64)
    z = 1 - (2 * i + 1) / count
    angle = i * math.pi * (3 - math.sqrt(5))
    radius = (1 - z * z).sqrt()
    return torch.stack((radius * angle.cos(), radius * angle.sin(), z), dim=1).float()

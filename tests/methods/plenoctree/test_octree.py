"""Leaves: what they show against a loop over them all, what a file of them takes."""

from __future__ import annotations

import math

import pytest
import torch

from bench.cameras import cast
from bench.types import Rays
from methods.kernels.spherical import spherical_harmonics
from methods.kernels.voxel_walk import Voxels
from methods.plenoctree.kernels.voxel_light import Light, render_voxels
from methods.plenoctree.octree import Octree
from methods.rendering.frame import rays_at_matter
from tests.methods.conftest import look_at_the_middle


def some_octree(leaves: int = 60, size: int = 16) -> Octree:
    generator = torch.Generator().manual_seed(1)
    cells = torch.cartesian_prod(*[torch.arange(4, 12)] * 3)
    chosen = cells[torch.randperm(len(cells), generator=generator)[:leaves]]
    density = 40 * torch.rand(leaves, generator=generator) - 5
    harmonics = torch.randn(leaves, 4, 3, generator=generator)
    return Octree(Voxels(chosen, size), Light(density, harmonics))


def slab(octree: Octree, leaf: int, origin: torch.Tensor, direction: torch.Tensor) -> list[float]:
    """Where a ray enters and leaves a leaf, in float64."""
    lower = octree.voxels.coordinates[leaf].double() / octree.voxels.resolution
    ends = torch.stack(
        ((lower - origin) / direction, (lower + 1 / octree.voxels.resolution - origin) / direction)
    )
    return [ends.amin(0).amax().item(), ends.amax(0).amin().item()]


def test_the_picture_of_the_visible_leaves_is_that_of_a_plain_loop_over_all() -> None:
    octree = some_octree()
    visible = octree.visible()
    assert len(visible.voxels) == (octree.light.density > 0).sum() < 60
    camera = look_at_the_middle(0.13, 0.4)
    every = cast(camera)
    rays = Rays(every.origins[::9], every.directions[::9])
    pixels, _, _ = render_voxels(rays, visible.voxels, visible.light, stop=0.0)
    for ray in range(len(rays.origins)):
        origin, direction = rays.origins[ray].double(), rays.directions[ray].double()
        pieces = [(*slab(octree, leaf, origin, direction), leaf) for leaf in range(60)]
        towards = (direction / direction.norm()).float()[None]
        basis = spherical_harmonics(towards, backend="reference")[0, :4].double()
        light, colour = 1.0, torch.zeros(3, dtype=torch.float64)
        for near, far, leaf in sorted(piece for piece in pieces if piece[1] > piece[0]):
            sigma = max(octree.light.density[leaf].item(), 0)
            weight = light * -math.expm1(-sigma * (far - near) * direction.norm().item())
            colour += weight * (basis @ octree.light.harmonics[leaf].double()).sigmoid()
            light -= weight
        # 24 leaves at most, densities below 35, entry and exit rounded as in the kernel's cases.
        assert (pixels.values[ray].double() - colour).abs().max() < 1e-4
        assert abs(pixels.alpha[ray].item() - (1 - light)) < 1e-4


def test_the_occupancy_has_every_leaf() -> None:
    octree = some_octree(size=64)
    cells = octree.occupancy.cells
    assert cells.shape == (16, 16, 16)
    x, y, z = (octree.voxels.coordinates // 4).unbind(dim=1)
    assert cells[x, y, z].all()
    assert cells.sum() == len((octree.voxels.coordinates // 4).unique(dim=0))


def test_what_a_file_holds_comes_back() -> None:
    octree = some_octree()
    again = Octree.of(octree.tensors(), torch.device("cpu"))
    assert torch.equal(again.voxels.leaves, octree.voxels.leaves)
    assert torch.equal(again.light.harmonics, octree.light.harmonics)


def test_rounded_leaves_are_16_bit_numbers_and_positive() -> None:
    octree = some_octree()
    octree.light.density[:2] = torch.tensor([1e6, 1e-9])  # opaque, and 0 with 16 bits
    rounded = octree.rounded().light
    for values in (rounded.density, rounded.harmonics):
        assert torch.equal(values, values.half().float())
        assert values.isfinite().all()
    assert (rounded.density > 0).all()
    wanted = octree.visible().light.density[2:]
    torch.testing.assert_close(rounded.density[1:], wanted, rtol=2**-11, atol=0)


def test_where_no_leaf_is_visible_there_is_nothing_to_see() -> None:
    octree = some_octree(size=64)
    octree.light.density[:] = -1
    camera = look_at_the_middle(0.13, 0.4)
    visible = octree.visible()
    seen, _ = rays_at_matter(camera, visible.occupancy)
    assert len(visible.voxels) == len(seen) == 0
    pixels, _, _ = render_voxels(cast(camera), visible.voxels, visible.light)
    assert (pixels.alpha == 0).all()


@pytest.mark.parametrize("width", [2, 4])
def test_sizes_are_values_and_what_finds_them(width: int) -> None:
    octree = some_octree()
    bricks = len((octree.voxels.coordinates // 8).unique(dim=0))
    assert octree.sizes(width) == {
        "leaves": 60 * (1 + 4 * 3) * width,
        "index": 4 * 2**3 + bricks * (64 + 4),
    }

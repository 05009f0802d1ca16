"""Leaves: what they show against a loop over them all, what a file of them takes."""

import math

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


def test_the_picture_of_the_visible_leaves_is_that_of_a_plain_loop_over_all():
    octree = some_octree()
    visible = octree.visible()
    assert len(visible.voxels) == (octree.light.density > 0).sum() < 60
    every = cast(look_at_the_middle(0.13, 0.4))
    rays = Rays(every.origins[::9], every.directions[::9])
    pixels, _, _ = render_voxels(rays, visible.voxels, visible.light, stop=0.0)
    lower = octree.voxels.coordinates.double() / 16
    for ray in range(len(rays.origins)):
        origin, direction = rays.origins[ray].double(), rays.directions[ray].double()
        ends = torch.stack(((lower - origin) / direction, (lower + 1 / 16 - origin) / direction))
        near, far = ends.amin(dim=0).amax(dim=1), ends.amax(dim=0).amin(dim=1)
        towards = (direction / direction.norm()).float()[None]
        basis = spherical_harmonics(towards)[0, :4].double()
        light, colour = 1.0, torch.zeros(3, dtype=torch.float64)
        for leaf in near.argsort()[(near < far)[near.argsort()]].tolist():
            sigma = max(octree.light.density[leaf].item(), 0)
            length = (far[leaf] - near[leaf]) * direction.norm()
            weight = light * -math.expm1(-sigma * length.item())
            colour += weight * (basis @ octree.light.harmonics[leaf].double()).sigmoid()
            light -= weight
        # 24 leaves at most, densities below 35, entry and exit rounded as in the kernel's cases.
        assert (pixels.values[ray].double() - colour).abs().max() < 1e-4
        assert abs(pixels.alpha[ray].item() - (1 - light)) < 1e-4


def test_the_occupancy_has_every_leaf_and_no_other_cell():
    octree = some_octree(size=64)
    found = octree.occupancy.cells.nonzero()
    assert octree.occupancy.resolution == 16
    assert torch.equal(found, (octree.voxels.coordinates // 4).unique(dim=0))


def test_rounded_leaves_are_16_bit_numbers_and_positive():
    octree = some_octree()
    octree.light.density[:2] = torch.tensor([1e6, 1e-9])  # opaque, and 0 with 16 bits
    rounded = octree.visible("fp16").light
    for values in (rounded.density, rounded.harmonics):
        assert torch.equal(values, values.half().float())
        assert values.isfinite().all()
    assert (rounded.density > 0).all()
    wanted = octree.visible().light.density[2:]
    torch.testing.assert_close(rounded.density[1:], wanted, rtol=2**-11, atol=0)


def test_where_no_leaf_is_visible_there_is_nothing_to_see():
    octree = some_octree(size=64)
    octree.light.density[:] = -1
    camera = look_at_the_middle(0.13, 0.4)
    visible = octree.visible()
    seen, _ = rays_at_matter(camera, visible.occupancy)
    assert len(visible.voxels) == len(seen) == 0
    pixels, _, _ = render_voxels(cast(camera), visible.voxels, visible.light)
    assert (pixels.alpha == 0).all()


def test_sizes_are_values_and_what_finds_them():
    octree = some_octree()
    bricks = len((octree.voxels.coordinates // 8).unique(dim=0))
    index = 4 * 2**3 + bricks * (64 + 4)
    assert octree.sizes(2) == {"leaves": 60 * (1 + 4 * 3) * 2, "index": index}

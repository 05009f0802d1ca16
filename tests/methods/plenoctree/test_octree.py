"""Leaves: what they show against all of them by definition, what a file of them takes."""

import torch
from torch.nn.functional import normalize

from bench.cameras import cast
from bench.types import Rays
from methods.kernels.spherical import spherical_harmonics
from methods.kernels.voxel_walk import Voxels
from methods.plenoctree.kernels.voxel_light import Light, render_voxels
from methods.plenoctree.octree import Octree
from methods.rendering.frame import rays_at_matter
from tests.common import assert_near, seeded
from tests.methods.conftest import look_at_the_middle


def some_octree(leaves: int = 60, size: int = 16) -> Octree:
    generator = seeded(1)
    cells = torch.cartesian_prod(*[torch.arange(4, 12)] * 3)
    chosen = cells[torch.randperm(len(cells), generator=generator)[:leaves]]
    density = 40 * torch.rand(leaves, generator=generator) - 5
    harmonics = torch.randn(leaves, 4, 3, generator=generator)
    return Octree(Voxels(chosen, size), Light(density, harmonics))


def test_the_picture_of_the_visible_leaves_is_that_of_all_composited_by_definition():
    octree = some_octree()
    visible = octree.visible()
    assert len(visible.voxels) == (octree.light.density > 0).sum() < 60
    every = cast(look_at_the_middle(0.13, 0.4))
    rays = Rays(every.origins[::9], every.directions[::9])
    pixels, _, _ = render_voxels(rays, visible.voxels, visible.light, stop=0.0)

    origins = rays.origins.double()[:, None]
    directions = rays.directions.double()[:, None]
    lower = octree.voxels.coordinates.double() / 16
    first = (lower - origins) / directions
    last = (lower + 1 / 16 - origins) / directions
    near = torch.minimum(first, last).amax(dim=2)  # [R, N]
    far = torch.maximum(first, last).amin(dim=2)
    length = (far - near).clamp(min=0) * directions.norm(dim=2)
    near, order = near.sort(dim=1)
    depth = octree.light.density.clamp(min=0) * length
    depth = depth.gather(1, order)
    light = torch.exp(depth - depth.cumsum(dim=1))
    weights = light * -torch.expm1(-depth)

    towards = normalize(directions[:, 0], dim=1)
    basis = spherical_harmonics(towards)[:, :4]
    harmonics = octree.light.harmonics.double()[order]
    shown = torch.einsum("rk,rnkc->rnc", basis, harmonics).sigmoid()
    colours = (weights[..., None] * shown).sum(dim=1)
    # 24 leaves at most, densities below 35, entry and exit rounded as in the kernel's cases.
    assert_near(pixels.values.double(), colours, atol=1e-4)
    assert_near(pixels.alpha.double(), weights.sum(dim=1), atol=1e-4)


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

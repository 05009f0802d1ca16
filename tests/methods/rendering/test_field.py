"""A radiance field that is no network: its rays, its density grid, padding."""

import pytest
import torch

from bench.cameras import cast
from methods.kernels.types import Occupancy
from methods.rendering.batch import render_batch
from methods.rendering.field import BATCH_QUANTUM, pad
from methods.rendering.frame import render_rays
from methods.rendering.occupancy import RESOLUTION, DensityGrid
from methods.rendering.sampling import Sampling
from tests.common import seeded
from tests.methods.conftest import Work, look_at_the_middle
from tests.methods.solids import DENSITY, Solid, ball

EVERYWHERE = Occupancy(torch.ones(32, 32, 32, dtype=torch.bool))


def test_rays_of_a_solid_end_at_its_surface():
    field, rays = Solid(ball()), cast(look_at_the_middle(0.1, 0.4))
    work = Work()
    pixels = render_rays(field, rays, EVERYWHERE, work, Sampling())
    batch, used = render_batch(field, rays, EVERYWHERE, Sampling())
    middle = (32 * 32 + 32) // 2
    for got in (pixels, batch):
        assert got.alpha[middle] > 0.99
        # The camera is 1.6 away, the ball has a radius of 0.3; a few steps of 1 / 600.
        assert got.depth_sum[middle] / got.alpha[middle] == pytest.approx(1.3, abs=0.01)
        assert got.values[middle, 3] == pytest.approx(0.25, abs=1e-3)
    assert 0 < work.done["shaded_samples"] < work.done["samples"]
    assert used > 0


def test_the_density_grid_finds_a_solid():
    slice_ = torch.zeros(RESOLUTION, RESOLUTION, RESOLUTION, dtype=torch.bool)
    slice_[62:66] = True  # through the middle of the ball
    grid, generator = DensityGrid(slice_), seeded(0)
    for _ in range(4):
        grid.update(Solid(ball()), generator, samples=2 * int(slice_.sum()))
    axis = (torch.arange(RESOLUTION) + 0.5) / RESOLUTION - 0.5
    radius = (axis[:, None, None] ** 2 + axis[:, None] ** 2 + axis**2).sqrt()
    cells = grid.occupancy.cells
    inside, outside = slice_ & (radius < 0.28), slice_ & (radius > 0.32)
    assert cells[inside].all()
    assert (grid.density[inside] == DENSITY).float().mean() > 0.9
    # All but the one in e^4 that were left out were found to be empty.
    assert cells[outside].float().mean() < 0.05
    assert not cells[~slice_].any()


def test_padding_hides_behind_the_samples():
    rows = torch.rand(BATCH_QUANTUM + 1, 3)
    padded = pad(rows)
    assert len(padded) == 2 * BATCH_QUANTUM
    assert torch.equal(padded[: len(rows)], rows)
    assert not padded[len(rows) :].any()
    assert pad(rows[:BATCH_QUANTUM]).shape == (BATCH_QUANTUM, 3)

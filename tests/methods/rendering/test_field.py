"""A radiance field that is no network: its density grid, padding."""

import torch

from methods.rendering.field import BATCH_QUANTUM, pad
from methods.rendering.occupancy import RESOLUTION, DensityGrid
from tests.common import seeded
from tests.methods.solids import DENSITY, Solid, ball


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

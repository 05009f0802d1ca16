"""The density grid that tells where a field is empty."""

import math
from dataclasses import replace

import pytest
import torch

from methods.rendering.occupancy import (
    DECAY,
    INITIAL,
    RESOLUTION,
    THRESHOLD,
    DensityGrid,
    learnable_cells,
)
from tests.common import seeded
from tests.methods.conftest import look_at_the_middle
from tests.methods.solids import Solid, slab

UNIT_CUBE = torch.tensor([[0.0] * 3, [1.0] * 3])
WHOLE = torch.ones(RESOLUTION, RESOLUTION, RESOLUTION, dtype=torch.bool)
AROUND = [look_at_the_middle(turn / 4, lift) for turn in range(4) for lift in (-0.5, 0.5)]
GENERATOR = seeded(0)


def quarter(sigma: float) -> Solid:
    """A field of density `sigma` where x < 1/4, nothing elsewhere."""
    return Solid(slab(-1.0, 0.25), density=sigma)


def test_cells_outside_the_bounds_cannot_be_learnt():
    cells = learnable_cells(torch.tensor([[0.375, 0.375, 0.375], [0.625, 0.5, 0.625]]), AROUND)
    inside = torch.zeros_like(WHOLE)
    inside[48:80, 48:64, 48:80] = True
    assert torch.equal(cells, inside)  # in the middle, where every camera looks


def test_what_one_camera_sees_cannot_be_learnt():
    one, other = AROUND[:2]
    assert not learnable_cells(UNIT_CUBE, [one]).any()
    assert learnable_cells(UNIT_CUBE, [one, other]).any()
    behind = replace(other, c2w=other.c2w * torch.tensor([[-1.0, 1.0, -1.0, 1.0]]))  # turned away
    assert not learnable_cells(UNIT_CUBE, [one, behind]).any()


def test_where_space_has_no_end_what_is_distant_can_always_be_learnt():
    cells = learnable_cells(UNIT_CUBE, AROUND[:1], contracted=True)
    at = (torch.arange(RESOLUTION) + 0.5) / RESOLUTION - 0.5
    far = torch.stack(torch.meshgrid(at, at, at, indexing="ij")).abs().amax(dim=0) > 0.375
    assert not (cells & ~far).any()  # from two half sides on, a contracted 3/2
    assert (far & ~cells).sum() <= (4 * 4) ** 3  # at the camera


def test_cells_at_a_camera_cannot_be_learnt():
    inside = replace(AROUND[0], c2w=AROUND[0].c2w.clone())
    inside.c2w[:, 3] = torch.tensor([0.51, 0.51, 0.51])
    without, with_it = (learnable_cells(UNIT_CUBE, x) for x in (AROUND, [*AROUND, inside]))
    lost = (without & ~with_it).nonzero()
    assert len(lost) == (3 * 4) ** 3  # the camera's brick and those that touch it
    assert ((lost + 0.5) / RESOLUTION - 0.51).abs().max() < 2 / 32


def test_a_cell_is_occupied_until_it_was_visited_and_keeps_its_value_in_between():
    grid = DensityGrid(WHOLE)
    grid.update(quarter(0.0), GENERATOR, samples=4096)
    visited = grid.density < INITIAL
    assert 0 < visited.sum() <= 4096
    torch.testing.assert_close(
        grid.density[visited], torch.full((int(visited.sum()),), DECAY * INITIAL)
    )
    assert torch.equal(grid.occupancy.cells, ~visited)


def test_a_density_that_is_not_a_number_is_as_good_as_none():
    grid, other = DensityGrid(WHOLE), DensityGrid(WHOLE)
    for one, sigma in ((grid, math.nan), (other, 0.0)):
        one.update(quarter(sigma), seeded(1), samples=4096)
    assert torch.equal(grid.density, other.density)


@pytest.mark.slow
def test_matter_that_is_thin_everywhere_is_kept_where_it_is_denser_than_the_mean():
    thin = quarter(0.1 * THRESHOLD)
    grid = DensityGrid(WHOLE)
    for _ in range(24):  # 1.2 * 0.8^24 < 0.1
        grid.update(thin, GENERATOR, samples=2 * grid.density.numel())
    cells = grid.occupancy.cells
    assert cells[: RESOLUTION // 4].all()
    assert cells[RESOLUTION // 4 :].float().mean() < 0.5

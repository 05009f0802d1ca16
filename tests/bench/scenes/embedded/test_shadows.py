"""Tiles: no point that a box may keep from the light is left out."""

import pytest
import torch

from bench.scenes.embedded.shadows import TILES, Tiles


@pytest.mark.parametrize("count", [1, 5, 3000])
def test_the_points_under_a_box_are_in_its_runs(count):
    generator = torch.Generator().manual_seed(count)
    points = torch.rand(count, 3, generator=generator)
    tiles = Tiles(points)
    assert sorted(tiles.order.tolist()) == list(range(count))
    ordered, left_out = points[tiles.order], 0
    for _ in range(40):
        low, high = torch.rand(2, 3, generator=generator).sort(dim=0).values.unbind(0)
        under = (ordered[:, :2] >= low[:2]) & (ordered[:, :2] <= high[:2])
        needed = under.all(1) & (ordered[:, 2] < high[2])
        if not tiles.casters(low[None], high[None]):
            assert not needed.any()
            continue
        runs = tiles.runs(low, high)
        given = torch.zeros(count, dtype=torch.bool)
        for run in runs:
            assert run.start < run.stop
            assert not given[run].any()
            given[run] = True
        assert given[needed].all()
        left_out += (~given).sum().item()
        near = (ordered[:, :2] > low[:2] - 1 / TILES) & (ordered[:, :2] < high[:2] + 1 / TILES)
        assert not given[~near.all(1)].any()
    assert left_out > 0 or count == 1


def test_points_in_one_place_share_a_tile():
    tiles = Tiles(torch.full((7, 3), 0.25))
    assert tiles.runs(torch.zeros(3), torch.ones(3)) == [slice(0, 7)]
    assert tiles.runs(torch.zeros(3), torch.tensor((1.0, 1.0, 0.2))) == []

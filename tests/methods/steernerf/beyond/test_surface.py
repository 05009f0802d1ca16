"""The field at the surface, a sample a pixel, whoever looks at which piece of it."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from tests.methods.test_joint import misty_field
from tests.methods.test_pipeline import ALL_CELLS, CAMERA, OPTIONS, new_pipeline

from bench.cameras import pixel_grid, unproject
from bench.types import NullProbe
from methods.steernerf.beyond.surface import LAYER, Surface
from methods.steernerf.view import View
from tests.methods.conftest import Work
from tests.methods.observations import to_blocks

VIEW, Z = View.of(CAMERA, 4), 1.5
CELLS = torch.arange(8, 64)  # not the first row
NEAR = torch.zeros(32, 32, dtype=torch.bool)
NEAR[10:22, 6:22] = True
BLOCKS = to_blocks(NEAR[..., None], 4).flatten(0, 1)[CELLS, :, 0]


def new_surface() -> Surface:
    """192 pixels, Z in front of the camera."""
    return Surface(misty_field("fp32"), torch.where(BLOCKS, Z, torch.inf), CELLS, VIEW, 4)


def test_its_opacity_is_that_of_a_layer_of_the_field() -> None:
    """At a pixel's own point; pixels without a depth have no point."""
    surface = new_surface().points(NullProbe())
    assert torch.equal(surface.index >= 0, BLOCKS)
    whole = torch.full((64, 16), -1).index_copy(0, CELLS, surface.index.long())
    index = whole.view(8, 8, 4, 4).transpose(1, 2).reshape(32, 32)[NEAR]
    assert torch.equal(index.sort().values, torch.arange(192))
    pixels = pixel_grid(32, 32, NEAR.device)[NEAR.flatten()]
    points = unproject(VIEW.full, pixels, torch.full((192,), Z))
    opacity = 1 - torch.exp(-LAYER * misty_field("fp32").density(points)[0])
    assert opacity.std() > 1e-3  # not the same everywhere
    assert surface.values.shape == (192, OPTIONS.channels + 1)
    torch.testing.assert_close(surface.values[index, -1], opacity, rtol=1e-5, atol=1e-6)


def test_where_no_pixel_has_a_depth_there_is_none() -> None:
    nowhere = torch.full((64, 16), torch.inf)
    surface = Surface(misty_field("fp32"), nowhere, ALL_CELLS, VIEW, 4)
    assert len(surface) == 0
    points = surface.points(NullProbe())
    assert points.values.shape == (0, OPTIONS.channels + 1)
    assert (points.index == -1).all()


def test_a_pipeline_that_has_no_use_for_it_has_none() -> None:
    pipeline = new_pipeline(replace(OPTIONS, surface=False))
    assert pipeline.glance(CAMERA, (), 0, NullProbe()).sight.surface is None


@pytest.fixture
def small_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("methods.steernerf.beyond.surface.PIECE", 50)  # the last of four is shorter


def test_in_pieces_it_is_the_same_and_the_same_work(
    small_pieces: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    work = Work()
    pieces = new_surface().points(work)
    monkeypatch.undo()
    whole = new_surface().points(NullProbe())
    assert torch.equal(pieces.index, whole.index)
    # Sums of float32 in another order.
    torch.testing.assert_close(pieces.values, whole.values, rtol=1e-5, atol=1e-6)
    assert work.done["table_reads"] == 192 * 8 * misty_field("fp32").levels


def test_who_has_enough_stops_and_the_rest_is_looked_at_later(small_pieces: None) -> None:
    surface, looks = new_surface(), iter((False, False, True))
    first, rest = Work(), Work()
    surface.look(first, lambda: next(looks))
    assert torch.equal(surface.points(rest).values, new_surface().points(NullProbe()).values)
    reads = 8 * misty_field("fp32").levels
    assert (first.done["table_reads"], rest.done["table_reads"]) == (100 * reads, 92 * reads)

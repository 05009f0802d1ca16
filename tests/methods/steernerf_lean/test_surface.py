"""The field at the surface, a sample a pixel, in pieces or at once."""

from __future__ import annotations

import pytest
import torch

from bench.cameras import pixel_grid, unproject
from bench.types import NullProbe, Probe
from methods.steernerf.renderer import Points
from methods.steernerf.view import View
from methods.steernerf_lean.surface import LAYER, surface_points
from tests.methods.conftest import Work, look_at_the_middle
from tests.methods.models import SMALL_GRID, misty_field
from tests.methods.observations import to_blocks

CHANNELS = 4
VIEW, Z = View.of(look_at_the_middle(0.1, 0.3), 4), 1.5
CELLS = torch.arange(8, 64)  # not the first row
NEAR = torch.zeros(32, 32, dtype=torch.bool)
NEAR[10:22, 6:22] = True
BLOCKS = to_blocks(NEAR[..., None], 4).flatten(0, 1)[CELLS, :, 0]


def new_surface(probe: Probe) -> Points:
    """Of 192 pixels, Z in front of the camera."""
    depth = torch.where(BLOCKS, Z, torch.inf)
    return surface_points(misty_field("fp32"), depth, CELLS, VIEW, 4, probe)


def test_its_opacity_is_that_of_a_layer_of_the_field() -> None:
    """At a pixel's own point; pixels without a depth have no point."""
    surface = new_surface(NullProbe())
    assert torch.equal(surface.index >= 0, BLOCKS)
    whole = torch.full((64, 16), -1).index_copy(0, CELLS, surface.index.long())
    index = whole.view(8, 8, 4, 4).transpose(1, 2).reshape(32, 32)[NEAR]
    assert torch.equal(index.sort().values, torch.arange(192))
    pixels = pixel_grid(32, 32, NEAR.device)[NEAR.flatten()]
    points = unproject(VIEW.full, pixels, torch.full((192,), Z))
    opacity = 1 - torch.exp(-LAYER * misty_field("fp32").density(points)[0])
    assert opacity.std() > 1e-3  # not the same everywhere
    assert surface.values.shape == (192, CHANNELS + 1)
    torch.testing.assert_close(surface.values[index, -1], opacity, rtol=1e-5, atol=1e-6)


def test_where_no_pixel_has_a_depth_there_is_none() -> None:
    nowhere, work = torch.full((64, 16), torch.inf), Work()
    points = surface_points(misty_field("fp32"), nowhere, torch.arange(64), VIEW, 4, work)
    assert not work.done["surface_samples"]
    assert points.values.shape == (0, CHANNELS + 1)
    assert (points.index == -1).all()


@pytest.fixture
def small_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    # The last of four is shorter.
    monkeypatch.setattr("methods.steernerf_lean.surface.CACHED_SAMPLES", 50)


def test_in_pieces_it_is_the_same_and_the_same_work(
    small_pieces: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    work = Work()
    pieces = new_surface(work)
    monkeypatch.undo()
    whole = new_surface(NullProbe())
    assert torch.equal(pieces.index, whole.index)
    # Sums of float32 in another order.
    torch.testing.assert_close(pieces.values, whole.values, rtol=1e-5, atol=1e-6)
    assert work.done["surface_samples"] == 192
    assert work.done["table_reads"] == 192 * 8 * SMALL_GRID.levels

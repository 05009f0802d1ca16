"""What the lean 2D renderer is shown: the preceding picture, where it is warped to and how much the
views share, and the field at the surface, a sample a pixel."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from bench.cameras import pixel_grid, unproject
from bench.types import Camera, NullProbe, Probe
from methods.rendering.frame import FeatureFrame
from methods.steernerf.buffer import Buffer, Cloud
from methods.steernerf.unet import Points
from methods.steernerf_lean import observation
from methods.steernerf_lean import pipeline as pipelines
from methods.steernerf_lean.kernels.warp import enlarge, warp
from methods.steernerf_lean.observation import LAYER, Kept, overlap, surface_points
from tests.methods.conftest import Work, look_at_the_middle
from tests.methods.models import (
    SMALL_GRID,
    lean_model,
    lean_pipeline,
    lean_rendering,
    misty_field,
)
from tests.methods.observations import to_blocks

CAMERA = look_at_the_middle(0.1, 0.3)
VIEW, Z = lean_pipeline().view(CAMERA), 1.5
ALL_CELLS = torch.arange(64)
"""Of its 32 x 32 pixels."""


def test_the_preceding_picture_of_a_still_camera_is_where_it_was() -> None:
    pipeline, buffer = lean_pipeline(), Buffer(maxlen=1)
    frame = pipeline.render(CAMERA, buffer, lean_rendering(), NullProbe())
    fine = enlarge(frame.depth[::4, ::4], ALL_CELLS, 4)
    kept = buffer[0]
    assert isinstance(kept, Kept)
    values, valid = warp(kept.picture, kept.full, fine, ALL_CELLS, VIEW.full, 4)
    blocks = frame.rgb.view(8, 4, 8, 4, 3).transpose(1, 2).reshape(64, 16, 3)
    known = valid > 0
    assert known.float().mean() > 0.2
    # Positions are off by some ulps of 32 pixels, and neighbours differ by at most 1.
    assert (values - blocks)[known].abs().max() < 1e-4


@pytest.mark.parametrize("frames", [0, 1])
def test_without_a_preceding_frame_nothing_is_warped(
    frames: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With L = 0 never, with L = 1 from the second frame on."""
    warped = []
    monkeypatch.setattr(pipelines, "warp", lambda *given, **_: warped.append(given))
    pipeline, buffer = lean_pipeline(lean_model(frames=frames)), Buffer(maxlen=frames)
    for angle in (0.1, 0.11, 0.12):
        camera = look_at_the_middle(angle, 0.3)
        pipeline.render(camera, buffer, lean_rendering(), NullProbe())
    assert len(warped) == 2 * frames


def far_view(angle: float, aside: float = 0.0) -> Camera:
    """64 x 64 pixels of 1.25 units, 1000 units away, looking past the middle by `aside`."""
    axis = torch.tensor((math.sin(angle), 0.0, math.cos(angle)))
    down = torch.tensor((0.0, 1.0, 0.0))
    right = torch.linalg.cross(down, -axis)
    c2w = torch.stack((right, down, -axis, 1000 * axis + aside * right), dim=1)
    focal = 64 / 1.25 * 1000
    return Camera(c2w, focal, focal, 32.0, 32.0, 64, 64)


def ball_cloud(opacity: float = 1.0) -> Cloud:
    """A ball of radius 0.5 around the origin, as `far_view(0)` sees it; it fills half of the
    picture."""
    pixels = (pixel_grid(64, 64) - 32) * 1.25 / 64
    height = 0.25 - pixels.square().sum(dim=1)
    depth = torch.where(height > 0, 1000 - height.clamp(min=0).sqrt(), math.inf).view(64, 64)
    values = torch.zeros(64, 64, 4)
    return Cloud.of(FeatureFrame(far_view(0.0), values, depth, opacity * (depth < math.inf)))


@pytest.mark.parametrize("opacity", [0.3, 1.0])
@pytest.mark.parametrize("degrees", [0, 30, 60, 90, 135, 180])
def test_two_views_of_a_ball_overlap_by_what_faces_both(degrees: float, opacity: float) -> None:
    cloud, other = ball_cloud(opacity), far_view(math.radians(degrees))
    faces_both = float((ball_cloud().points[cloud.reliable] @ other.c2w[:3, 2] < 0).float().mean())
    # 2,000 pixels, of which the outline of what faces both crosses 100, and every eighth of those.
    assert overlap(cloud, other) == pytest.approx(faces_both, abs=0.05)


@pytest.mark.parametrize(("aside", "share"), [(0.0, 1.0), (0.625, 0.5), (1.2, 0.0), (-0.625, 0.5)])
def test_two_views_overlap_by_what_lies_inside_both(aside: float, share: float) -> None:
    assert overlap(ball_cloud(), far_view(0.0, aside)) == pytest.approx(share, abs=0.05)


def test_a_view_shares_nothing_with_what_is_behind_it_or_with_an_empty_frame() -> None:
    cloud, turned = ball_cloud(), torch.tensor((1.0, 1.0, 1.0, -1.0))
    behind = replace(far_view(0.0), c2w=far_view(0.0).c2w * turned)
    assert overlap(cloud, behind) == 0
    nothing = replace(cloud, alpha=torch.zeros_like(cloud.alpha))
    assert overlap(nothing, far_view(0.0)) == 0


CHANNELS = 4
CELLS = torch.arange(8, 64)  # not the first row
NEAR = torch.zeros(32, 32, dtype=torch.bool)
NEAR[10:22, 6:22] = True
BLOCKS = to_blocks(NEAR[..., None], 4).flatten(0, 1)[CELLS, :, 0]


def new_surface(probe: Probe) -> Points:
    """Of 192 pixels, Z in front of the camera."""
    depth = torch.where(BLOCKS, Z, torch.inf)
    return surface_points(misty_field("fp32"), depth, CELLS, VIEW, probe)


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


def test_in_pieces_it_is_the_same_and_the_same_work(monkeypatch: pytest.MonkeyPatch) -> None:
    work, whole = Work(), new_surface(NullProbe())
    monkeypatch.setattr(observation, "CACHED_SAMPLES", 50)  # the last of four is shorter
    pieces = new_surface(work)
    assert torch.equal(pieces.index, whole.index)
    # Sums of float32 in another order.
    torch.testing.assert_close(pieces.values, whole.values, rtol=1e-5, atol=1e-6)
    assert work.done["surface_samples"] == 192
    assert work.done["table_reads"] == 192 * 8 * SMALL_GRID.levels

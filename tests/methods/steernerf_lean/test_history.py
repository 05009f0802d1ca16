"""The preceding picture: how much of it the present view shares, and where it is warped to."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from bench.cameras import pixel_grid
from bench.types import Camera, NullProbe
from methods.rendering.frame import FeatureFrame
from methods.steernerf.buffer import Buffer, Cloud
from methods.steernerf.view import View
from methods.steernerf_lean.history import Kept, overlap
from methods.steernerf_lean.kernels.warp import enlarge
from tests.methods.conftest import look_at_the_middle
from tests.methods.models import lean_model, lean_pipeline, lean_rendering

CAMERA = look_at_the_middle(0.1, 0.3)
ALL_CELLS = torch.arange(64)
"""Of its 32 x 32 pixels."""


def test_the_preceding_picture_of_a_still_camera_is_where_it_was() -> None:
    pipeline, buffer = lean_pipeline(), Buffer(maxlen=1)
    frame = pipeline.render(CAMERA, buffer, lean_rendering(), NullProbe())
    fine = enlarge(frame.depth[::4, ::4], ALL_CELLS, 4)
    kept = buffer[0]
    assert isinstance(kept, Kept)
    history = kept.warped(fine, ALL_CELLS, View.of(CAMERA, 4), "cpu")
    blocks = frame.rgb.view(8, 4, 8, 4, 3).transpose(1, 2).reshape(64, 16, 3)
    known = history.valid > 0
    assert known.float().mean() > 0.2
    # Positions are off by some ulps of 32 pixels, and neighbours differ by at most 1.
    assert (history.values - blocks)[known].abs().max() < 1e-4


@pytest.mark.parametrize("frames", [0, 1])
def test_without_a_preceding_frame_nothing_is_warped(
    frames: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With L = 0 never, with L = 1 from the second frame on."""
    warped = []
    monkeypatch.setattr(Kept, "warped", lambda *given: warped.append(given))
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


def ball_cloud() -> Cloud:
    """A ball of radius 0.5 around the origin, as `far_view(0)` sees it; it fills half of the
    picture."""
    pixels = (pixel_grid(64, 64) - 32) * 1.25 / 64
    height = 0.25 - pixels.square().sum(dim=1)
    depth = torch.where(height > 0, 1000 - height.clamp(min=0).sqrt(), math.inf).view(64, 64)
    values = torch.zeros(64, 64, 4)
    return Cloud.of(FeatureFrame(far_view(0.0), values, depth, (depth < math.inf).float()))


@pytest.mark.parametrize("degrees", [0, 30, 60, 90, 135, 180])
def test_two_views_of_a_ball_overlap_by_what_faces_both(degrees: float) -> None:
    cloud, other = ball_cloud(), far_view(math.radians(degrees))
    faces_both = float((cloud.points[cloud.clear] @ other.c2w[:3, 2] < 0).float().mean())
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

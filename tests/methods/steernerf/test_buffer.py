"""Preceding frames: what is kept of them, and which pixels of another view show their points."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from bench.cameras import pixel_grid, project, scale_camera, unproject
from bench.types import EMPTY_ALPHA, Camera
from methods.rendering.frame import FeatureFrame
from methods.steernerf.buffer import SPLAT_ALPHA, Cloud, Remembered, RenderingBuffer
from methods.steernerf.kernels.splat import gather
from methods.steernerf.options import Reprojection
from tests.methods.conftest import look_at_the_middle

EXACT = Reprojection()
RELEASED = Reprojection(rule="last", centres="paper", depth="sum")
RELEASE = np.load(Path(__file__).parents[2] / "data" / "steernerf_release.npz")
"""Two frames of 10 x 12 pixels, brought into a third of 40 x 48 by the released code."""
BACKENDS = ["reference", "cpu"]


def frame_of(camera: Camera, depth: Tensor | None = None, alpha: float = 1.0) -> FeatureFrame:
    """A wavy surface of features that all differ."""
    shape = camera.height, camera.width
    if depth is None:
        row, column = torch.arange(shape[0])[:, None], torch.arange(shape[1])
        depth = 1.5 + 0.1 * torch.sin(row + 0.5 * column)
    values = torch.arange(depth.numel() * 4.0).view(*shape, 4)
    return FeatureFrame(camera, values, depth, torch.full(shape, alpha))


def low_camera(scale: int) -> Camera:
    """8 x 6 pixels, each s x s of a picture of which the principal point is not the middle."""
    camera = look_at_the_middle(0.1, 0.3)
    full = replace(camera, cx=4.25 * scale, cy=2.5 * scale, width=8 * scale, height=6 * scale)
    return scale_camera(replace(full, fx=9.0 * scale, fy=10.0 * scale), 8, 6)


def remembered(number: int) -> Remembered:
    camera = low_camera(1)
    cloud = Cloud.of(frame_of(camera), EXACT)
    return Remembered(cloud, camera, torch.full((6, 8, 3), float(number)))


@pytest.mark.parametrize("length", [0, 1, 3])
def test_a_buffer_keeps_the_newest_frames_newest_first(length: int) -> None:
    buffer = RenderingBuffer(length)
    assert buffer.frames == ()
    for number in range(5):
        buffer.push(remembered(number))
        shown = [int(frame.picture[0, 0, 0]) for frame in buffer.frames]
        assert shown == list(range(number, number - min(length, number + 1), -1))


def test_a_reset_forgets_all() -> None:
    buffer = RenderingBuffer(2)
    buffer.push(remembered(0))
    buffer.reset()
    assert buffer.frames == ()
    for number in range(3):
        buffer.push(remembered(number))
    assert len(buffer.frames) == 2


def test_a_copy_goes_on_by_itself() -> None:
    buffer = RenderingBuffer(2)
    buffer.push(remembered(0))
    copy = buffer.copy()
    assert copy.frames == buffer.frames
    for number in (1, 2):
        copy.push(remembered(number))
    assert [len(some.frames) for some in (buffer, copy)] == [1, 2]


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("scale", [1, 2, 3, 4])
def test_a_still_frame_is_shown_where_it_was_taken(scale: int, backend: str) -> None:
    low = low_camera(scale)
    full = scale_camera(low, 8 * scale, 6 * scale)
    cloud = Cloud.of(frame_of(low), EXACT)
    index, depth = cloud.splat(full, EXACT, backend)
    # s odd: in the middle of s x s pixels. s even: on a border, where rounding may choose any of
    # the four pixels around it.
    row, column = torch.meshgrid(torch.arange(6), torch.arange(8), indexing="ij")
    for point, (i, j) in enumerate(zip(column.flatten(), row.flatten(), strict=True)):
        at = (index == point).nonzero()
        assert len(at) == 1
        v, u = at[0].tolist()
        for place, pixel in ((u, int(i)), (v, int(j))):
            centre = scale * (pixel + 0.5)
            assert place <= centre <= place + 1
    assert (index >= 0).sum() == 48
    if scale == 1:
        assert torch.equal(index.flatten(), torch.arange(48).int())
    # Coordinates up to 2 are rounded a dozen times.
    torch.testing.assert_close(depth, frame_of(low).depth.flatten(), rtol=0, atol=24 * 2.0**-24)


def test_a_point_is_where_the_pixel_sees_it() -> None:
    low = low_camera(4)
    frame = frame_of(low)
    cloud = Cloud.of(frame, EXACT)
    assert torch.equal(cloud.source, torch.arange(48))
    assert torch.equal(cloud.values, frame.values.view(48, 4))
    assert torch.equal(cloud.points, unproject(low, pixel_grid(8, 6), frame.depth.flatten()))


def test_empty_and_faint_pixels_become_no_points() -> None:
    low = low_camera(4)
    frame = frame_of(low)
    frame.depth[0], frame.alpha[0] = math.inf, 0.0
    frame.alpha[1, 2] = EMPTY_ALPHA * 2  # has a depth
    frame.alpha[2, 2:4] = torch.tensor([SPLAT_ALPHA, SPLAT_ALPHA * 1.01])
    cloud = Cloud.of(frame, EXACT)
    left_out = [*range(8), 8 + 2, 16 + 2]
    assert cloud.source.tolist() == [pixel for pixel in range(48) if pixel not in left_out]
    for kept in (cloud.points, cloud.values, cloud.alpha):
        assert len(kept) == len(cloud.source)
    assert torch.equal(cloud.alpha, frame.alpha.flatten()[cloud.source])
    assert cloud.points.isfinite().all()


@pytest.mark.parametrize("backend", BACKENDS)
def test_an_empty_frame_is_shown_nowhere(backend: str) -> None:
    low = low_camera(2)
    frame = frame_of(low, torch.full((6, 8), math.inf), alpha=0.0)
    index, depth = Cloud.of(frame, EXACT).splat(low, EXACT, backend)
    assert (index == -1).all()
    assert depth.shape == (0,)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("age", [1, 2])
@pytest.mark.parametrize("which", ["zero_upsampling", "direct"])
def test_features_land_where_the_released_code_puts_them(
    which: str, age: int, backend: str
) -> None:
    """`warp_zero_upsampling`, with which it trains, and `warp_direct`, with which it renders. Six
    pixels of one frame are empty: they must write nothing that is seen."""
    given = {name: torch.from_numpy(RELEASE[f"warp.{name}"]) for name in ("poses", "depth")}
    cameras = [Camera(pose[:3], 14.0, 14.0, 6.0, 5.0, 12, 10) for pose in given["poses"]]
    features = np.concatenate((RELEASE["warp.rgb"][age], RELEASE["warp.feat"][age]))
    depth, values = given["depth"][age], torch.from_numpy(features).permute(1, 2, 0)
    seen = depth > 0
    frame = FeatureFrame(cameras[age], values, depth.where(seen, math.inf), seen.float())
    cloud = Cloud.of(frame, RELEASED)
    index, _ = cloud.splat(scale_camera(cameras[0], 48, 40), RELEASED, backend)
    # Features are moved, not computed: no rounding at all.
    wanted = torch.from_numpy(RELEASE[f"warp.{which}"][age]).permute(1, 2, 0)
    assert torch.equal(gather(cloud.values, index, backend=backend), wanted)


@pytest.mark.parametrize("scale", [3, 4])
def test_the_centres_of_the_release_are_off_by_a_constant(scale: int) -> None:
    paper = Reprojection(centres="paper")
    low = low_camera(scale)
    full = scale_camera(low, 8 * scale, 6 * scale)
    frame = frame_of(low)
    exact, _ = project(full, Cloud.of(frame, EXACT).points)
    cloud = Cloud.of(frame, paper)
    corner, _ = project(full, cloud.points)
    # s (i + 1/2) against s i + 1/2, which `splat` counts from the first centre.
    # A pixel is 9 s of a coordinate up to 2, rounded two dozen times.
    shift = exact - (corner + 0.5)
    expected = torch.full_like(shift, scale / 2 - 0.5)
    torch.testing.assert_close(shift, expected, rtol=0, atol=24 * 2 * 10 * scale * 2.0**-24)
    index, _ = cloud.splat(full, paper, "reference")
    assert torch.equal(index[::scale, ::scale].flatten(), torch.arange(48).int())
    assert (index >= 0).sum() == 48


def test_summed_depths_are_too_near_and_empty_pixels_lie_at_the_camera() -> None:
    low = low_camera(4)
    frame = frame_of(low)
    frame.alpha[:3] = 0.5
    frame.depth[5], frame.alpha[5] = math.inf, 0.0
    expected = Cloud.of(frame, EXACT)
    summed = Cloud.of(frame, Reprojection(depth="sum"))
    assert summed.source.tolist() == list(range(48))
    _, z = project(low, summed.points)
    _, true = project(low, expected.points)
    error = 24 * 2 * 2.0**-24
    torch.testing.assert_close(z[:24], 0.5 * true[:24], rtol=0, atol=error)
    torch.testing.assert_close(z[24:40], true[24:], rtol=0, atol=error)
    centre = low.c2w[:, 3].expand(8, 3)
    torch.testing.assert_close(summed.points[40:], centre, rtol=0, atol=1e-11)
    again = summed.expected()
    assert torch.equal(again.source, expected.source)
    torch.testing.assert_close(again.points, expected.points, rtol=0, atol=2 * error)


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_nearer_of_two_points_hides_the_other(backend: str) -> None:
    target = replace(low_camera(1), c2w=torch.eye(3, 4), cx=4.0, cy=3.0, fx=8.0, fy=8.0)
    pixels = torch.tensor([[4.5, 3.5], [4.6, 3.4], [1.5, 1.5], [1.5, 1.5]])
    depth = torch.tensor([2.0, 1.0, 1.0, 2.0])
    points = unproject(target, pixels, depth)
    cloud = Cloud(
        target,
        torch.arange(4),
        points,
        torch.zeros(4, 3),
        torch.ones(4),
    )
    index, seen = cloud.splat(target, EXACT, backend)
    assert (index[3, 4].item(), index[1, 1].item()) == (1, 2)
    assert (index >= 0).sum() == 2
    torch.testing.assert_close(seen, depth)
    last, _ = cloud.splat(target, Reprojection(rule="last"), backend)
    assert (last[3, 4].item(), last[1, 1].item()) == (1, 3)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_near_surface_hides_a_far_one_when_the_camera_moves(backend: str) -> None:
    camera = replace(low_camera(1), c2w=torch.eye(3, 4), cx=4.0, cy=3.0, fx=8.0, fy=8.0)
    depth = torch.full((6, 8), 4.0)
    depth[:, 2] = 1.0
    moved = replace(camera, c2w=camera.c2w.clone())
    moved.c2w[0, 3] = -0.5  # 4 pixels at depth 1, one at depth 4
    index, _ = Cloud.of(frame_of(camera, depth), EXACT).splat(moved, EXACT, backend)
    row = [-1, 0, 1, -1, 3, 4, 2, 6]
    assert index.tolist() == [[i + 8 * j if i >= 0 else -1 for i in row] for j in range(6)]


def far_view(angle: float, aside: float = 0.0) -> Camera:
    """64 x 64 pixels of 1.25 units, 1000 units away, looking past the middle by `aside`."""
    axis = torch.tensor((math.sin(angle), 0.0, math.cos(angle)))
    down = torch.tensor((0.0, 1.0, 0.0))
    right = torch.linalg.cross(down, -axis)
    c2w = torch.stack((right, down, -axis, 1000 * axis + aside * right), dim=1)
    focal = 64 / 1.25 * 1000
    return Camera(c2w, focal, focal, 32.0, 32.0, 64, 64)


def ball_cloud(options: Reprojection = EXACT) -> Cloud:
    """A ball of radius 0.5 around the origin, as `far_view(0)` sees it."""
    camera = far_view(0.0)
    pixels = (pixel_grid(64, 64) - 32) * 1.25 / 64
    height = 0.25 - pixels.square().sum(dim=1)
    depth = torch.where(height > 0, 1000 - height.clamp(min=0).sqrt(), math.inf).view(64, 64)
    frame = FeatureFrame(camera, torch.zeros(64, 64, 4), depth, (depth < math.inf).float())
    return Cloud.of(frame, options)


@pytest.mark.parametrize("degrees", [0, 30, 60, 90, 135, 180])
def test_two_views_of_a_ball_overlap_by_what_faces_both(degrees: float) -> None:
    cloud, other = ball_cloud(), far_view(math.radians(degrees))
    faces_both = float((cloud.points @ other.c2w[:3, 2] < 0).float().mean())
    # 2,000 pixels, of which the outline of what faces both crosses 100, and every eighth of those.
    assert cloud.overlap(other) == pytest.approx(faces_both, abs=0.05)


@pytest.mark.parametrize(("aside", "share"), [(0.0, 1.0), (0.625, 0.5), (1.2, 0.0), (-0.625, 0.5)])
def test_two_views_overlap_by_what_lies_inside_both(aside: float, share: float) -> None:
    assert ball_cloud().overlap(far_view(0.0, aside)) == pytest.approx(share, abs=0.05)


def test_empty_pixels_that_became_points_do_not_count_for_the_overlap() -> None:
    """The ball fills half of the picture."""
    cloud = ball_cloud(Reprojection(depth="sum"))
    assert len(cloud.points) == 64 * 64
    assert cloud.overlap(far_view(0.0)) == pytest.approx(1.0)


def test_a_view_shares_nothing_with_what_is_behind_it_or_with_an_empty_frame() -> None:
    behind = replace(far_view(0.0), c2w=far_view(0.0).c2w * torch.tensor((1.0, 1.0, 1.0, -1.0)))
    assert ball_cloud().overlap(behind) == 0
    nothing = frame_of(low_camera(1), alpha=0.0)
    assert Cloud.of(nothing, EXACT).overlap(low_camera(1)) == 0

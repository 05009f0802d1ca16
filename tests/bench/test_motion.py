"""Random motions keep what they promise: the target in view, the speed, the distance, the seed."""

import math
from dataclasses import replace
from functools import cache
from itertools import pairwise

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from bench.cameras import look_at, scale_camera
from bench.motion import (
    BEND_DEG,
    JITTER_DEG,
    JITTER_ZOOM,
    ZOOM,
    between,
    novel_view,
    preceding,
    rotation_between,
    viewing_target,
)
from bench.types import Camera
from tests.common import assert_near, refusal, seeded

TARGET = torch.tensor([0.5, 0.4, 0.6])
SEEDS = st.integers(0, 2**31)
FLOAT32 = 2e-6
"""Of a rotation and a centre about 2 units away, both rounded to float32."""


def camera_at(offset: list[float], aside: float = 0.0) -> Camera:
    """A camera at TARGET + `offset` that looks past the target by `aside`."""
    eye = TARGET.double() + torch.tensor(offset, dtype=torch.float64)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    target = TARGET.double() + aside * up
    return Camera(look_at(eye, target, up).float(), 61.0, 60.0, 20.0, 16.0, 40, 32)


def offset(camera: Camera) -> Tensor:
    return camera.c2w[:, 3].double() - TARGET.double()


def gaze_deg(camera: Camera) -> float:
    """Between the viewing axis and the direction to the target."""
    return angle_deg(camera.c2w[:, 2].double(), -offset(camera))


def angle_deg(a: Tensor, b: Tensor) -> float:
    return math.degrees(math.atan2(torch.linalg.cross(a, b).norm().item(), (a @ b).item()))


def turn_deg(first: Camera, second: Camera) -> float:
    return math.degrees(rotation_between(first, second).norm().item())


@given(SEEDS, st.floats(0, 5), st.floats(0, 5), st.sampled_from([0.0, 0.3]))
def test_a_motion_keeps_its_speed_its_gaze_and_its_distance(seed, one, other, aside):
    low, high = sorted((one, other))
    camera = camera_at([1.5, -1.0, 0.5], aside)
    path = [*preceding(camera, TARGET, 6, (low, high), seeded(seed)), camera]
    assert len(path) == 7
    turns = [turn_deg(before, after) for before, after in pairwise(path)]
    slack = math.degrees(2 * FLOAT32)
    assert max(turns) - min(turns) <= slack
    assert low - slack <= min(turns)
    assert max(turns) <= high + slack
    for before, after in pairwise(path):
        ratio = (offset(before).norm() / offset(after).norm()).item()
        assert abs(ratio - 1) <= ZOOM * min(high, 1.0) + FLOAT32
        # The axis is perpendicular to the gaze: the target sees no larger angle than the turn.
        assert angle_deg(offset(before), offset(after)) <= high + slack
    for frame in path:
        assert gaze_deg(frame) == pytest.approx(gaze_deg(camera), abs=slack)
        assert vars(frame) == vars(replace(camera, c2w=frame.c2w))
        assert frame.c2w.dtype == torch.float32
        identity = frame.c2w[:, :3].T @ frame.c2w[:, :3]
        assert_near(identity, torch.eye(3), atol=FLOAT32)


@given(SEEDS)
def test_a_motion_is_perpendicular_to_the_gaze_and_bends_slightly(seed):
    camera = camera_at([2.0, 0.0, 0.0])
    path = [*preceding(camera, TARGET, 8, (1.0, 1.0), seeded(seed)), camera]
    axes = []
    for before, after in pairwise(path):
        assert angle_deg(offset(before), offset(after)) == pytest.approx(1.0, abs=1e-3)
        axis = torch.linalg.cross(offset(before), offset(after))
        axes.append(axis / axis.norm())
    bends = [angle_deg(a, b) for a, b in pairwise(axes)]
    assert max(bends) <= BEND_DEG + 0.05  # float32 against a step of a degree


@given(SEEDS)
def test_a_camera_that_stands_still_is_exactly_still(seed):
    camera = camera_at([1.1, -0.7, 0.9], aside=0.2)
    for frame in preceding(camera, TARGET, 3, (0.0, 0.0), seeded(seed)):
        assert torch.equal(frame.c2w, camera.c2w)


def test_the_oldest_camera_comes_first_and_a_longer_motion_only_begins_earlier():
    camera = camera_at([2.0, 0.0, 0.0])
    short, long = (preceding(camera, TARGET, n, (1.0, 1.0), seeded(3)) for n in (2, 5))
    for a, b in zip(short, long[-2:], strict=True):
        assert torch.equal(a.c2w, b.c2w)
    assert [round(turn_deg(frame, camera)) for frame in long] == [5, 4, 3, 2, 1]
    assert preceding(camera, TARGET, 0, (1.0, 1.0), seeded(3)) == []
    (other,) = preceding(camera, TARGET, 1, (1.0, 1.0), seeded(4))
    assert not torch.allclose(other.c2w, short[-1].c2w, atol=1e-3)


@pytest.mark.parametrize(("count", "degrees"), [(-1, (0, 1)), (2, (2, 1)), (2, (-1, 1))])
def test_a_motion_that_cannot_be_is_refused(count, degrees):
    with refusal("count >= 0 and 0 <= low <= high", ValueError):
        preceding(camera_at([2.0, 0.0, 0.0]), TARGET, count, degrees, seeded(0))
    with refusal(r"target: expected shape \[3\]", ValueError):
        preceding(camera_at([2.0, 0.0, 0.0]), torch.zeros(2), 1, (0, 1), seeded(0))


@cache
def zone(count: int) -> tuple[list[Camera], float]:
    """Cameras on every side, between 2 and 2.5 units from the target; and how far the third nearest
    of one of them is at most, in degrees."""
    generator = seeded(7)
    ways = torch.randn(count, 3, generator=generator)
    ways /= ways.norm(dim=1, keepdim=True)
    distances = 2 + torch.rand(count, 1, generator=generator) / 2
    cameras = [camera_at(eye.tolist()) for eye in distances * ways]
    angles = (ways @ ways.T).clamp(-1, 1).acos()
    third = angles.sort(dim=1).values[:, 3]
    return cameras, math.degrees(third.max())


@given(SEEDS)
def test_a_novel_view_lies_in_the_zone_of_the_cameras(seed):
    cameras, apart = zone(60)
    view = novel_view(cameras, TARGET, seeded(seed))
    distance = offset(view).norm().item()
    assert 2 * (1 - JITTER_ZOOM) - 1e-5 <= distance <= 2.5 * (1 + JITTER_ZOOM) + 1e-5
    nearest = min(angle_deg(offset(view), offset(camera)) for camera in cameras)
    assert nearest <= apart / 2 + JITTER_DEG + 1
    assert vars(view) == vars(replace(cameras[0], c2w=view.c2w))
    again = novel_view(cameras, TARGET, seeded(seed))
    assert torch.equal(view.c2w, again.c2w)


def test_a_novel_view_lies_between_cameras_that_look_at_the_target_and_does_too():
    quarter = math.sqrt(0.5) * 2
    cameras = [camera_at([2.0, 0.0, 0.0]), camera_at([quarter, quarter, 0.0])]
    for seed in range(20):
        view = novel_view(cameras, TARGET, seeded(seed))
        assert offset(view).norm().item() == pytest.approx(2.0, rel=JITTER_ZOOM + 1e-5)
        angle = math.degrees(math.atan2(offset(view)[1].item(), offset(view)[0].item()))
        assert -JITTER_DEG - 0.1 <= angle <= 45 + JITTER_DEG + 0.1
        # The rotation is shared evenly, the centre goes along the chord: 45 degrees part them most.
        assert gaze_deg(view) < 1.0
    view = novel_view(cameras[:1], TARGET, seeded(0))  # of one camera: that one, jittered
    assert 0 < turn_deg(view, cameras[0]) <= JITTER_DEG
    assert gaze_deg(view) == pytest.approx(0.0, abs=1e-3)


def test_a_novel_view_lies_between_cameras_whose_pictures_have_one_size():
    """The nearest neighbours have a smaller picture, a camera farther away has not."""
    cameras = [camera_at([2.0, 0.1 * n, 0.0]) for n in range(-3, 4)]
    small = [scale_camera(camera, 20, 16) for camera in cameras]
    large = [camera_at([2.0, 0.0, 0.0]), camera_at([0.0, 2.0, 0.0])]
    views = [novel_view([*small, *large], TARGET, seeded(seed)) for seed in range(30)]
    assert {(view.width, view.height) for view in views} == {(20, 16), (40, 32)}
    assert max(angle_deg(offset(v), offset(large[0])) for v in views if v.width == 40) > 20


def test_the_ends_of_the_way_between_two_cameras_are_the_cameras():
    first = camera_at([2.0, 0.0, 0.0])
    second = replace(camera_at([0.0, 2.0, 0.5]), fx=80.0, cy=15.0)
    turn = rotation_between(first, second)
    for share, end in ((0.0, first), (1.0, second)):
        reached = between(first, second, turn, share)
        assert_near(reached.c2w, end.c2w, atol=FLOAT32)
        assert (reached.fx, reached.cy) == (end.fx, end.cy)
    middle = between(first, second, turn, 0.5)
    assert (middle.fx, middle.cy) == (70.5, 15.5)
    assert turn_deg(first, middle) == pytest.approx(turn_deg(middle, second), abs=1e-3)


def test_the_viewing_target_is_the_centre_of_the_bounds(tiny_scene):
    scene = replace(tiny_scene, bounds=torch.tensor([[0.0, 0.2, 0.4], [1.0, 0.4, 0.6]]))
    assert viewing_target(scene).tolist() == pytest.approx([0.5, 0.3, 0.5])

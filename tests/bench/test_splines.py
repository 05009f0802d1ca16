"""Paths without corners: through the keys, in even steps."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import chain, pairwise

import pytest
import torch

from bench.cameras import look_at, scale_camera
from bench.motion import between, rotation_between
from bench.splines import leading
from bench.types import Camera, SteerbenchError

TARGET = torch.tensor([0.5, 0.4, 0.6])


def camera_at(offset: list[float]) -> Camera:
    """A camera at TARGET + `offset` that looks at the target."""
    up = torch.tensor([0.0, 0.0, 1.0])
    pose = look_at(TARGET + torch.tensor(offset), TARGET, up)
    return Camera(pose.float(), 61.0, 60.0, 20.0, 16.0, 40, 32)


def ring(degrees: list[float]) -> list[Camera]:
    """Cameras around the target, two units away, that look at it."""
    angles = map(math.radians, degrees)
    return [camera_at([2 * math.cos(angle), 2 * math.sin(angle), 0.5]) for angle in angles]


def test_a_spline_goes_through_its_keys_in_even_steps() -> None:
    keys = ring([0, 30, 50, 90])
    pieces = leading(keys, TARGET, degrees=2.0)
    assert [piece[-1] for piece in pieces] == keys[1:]
    for first, piece in zip(keys, pieces, strict=False):
        turns = [rotation_between(*pair).norm() for pair in pairwise([first, *piece])]
        degrees = torch.stack(turns).rad2deg()
        assert degrees.max() <= 2.0 + 1e-2  # float32 poses
        assert degrees.min() > 0.9 * degrees.max()


def test_a_spline_has_no_corners() -> None:
    keys = ring([0, 30, 60, 90, 120])
    path = [keys[0], *chain(*leading(keys, TARGET, degrees=1.0))]
    steps = torch.stack([camera.c2w[:, 3].double() for camera in path]).diff(dim=0)
    ways = torch.nn.functional.normalize(steps, dim=1)
    bends = (ways[1:] * ways[:-1]).sum(dim=1).clamp(max=1).acos().rad2deg()
    assert bends.max() < 2.0  # a circle bends by 1 degree a step, a chord's end by 30


def test_a_spline_through_two_keys_is_the_way_between_them() -> None:
    first, second = ring([10, 50])
    turn = rotation_between(first, second)
    (piece,) = leading([first, second], TARGET, degrees=5.0)
    for number, camera in enumerate(piece, 1):
        expected = between(first, second, turn, number / len(piece))
        torch.testing.assert_close(camera.c2w, expected.c2w, rtol=0, atol=2e-2)


def test_a_camera_that_only_moves_is_led_in_steps_seen_from_the_target() -> None:
    first = camera_at([2.0, 0.0, 0.0])
    aside = torch.cat((torch.zeros(3, 3), torch.tensor([[0.0], [1.0], [0.0]])), dim=1)
    (piece,) = leading([first, replace(first, c2w=first.c2w + aside)], TARGET, degrees=1.0)
    # Of moving by dy at a distance of sqrt(4 + y^2) the target sees dy / sqrt(4 + y^2).
    assert len(piece) == math.ceil(math.degrees(math.asinh(1 / 2)))


@pytest.mark.parametrize("case", ["one key", "the same pose twice", "another size"])
def test_a_spline_needs_different_keys_of_one_size(case: str) -> None:
    first, second = ring([0, 10])
    keys = {
        "one key": [first],
        "the same pose twice": [first, first, second],
        "another size": [first, scale_camera(second, 20, 16)],
    }[case]
    with pytest.raises(SteerbenchError, match="of one size" if "size" in case else "two cameras"):
        leading(keys, TARGET, degrees=1.0)

"""Camera paths: in files, there and back; through key cameras, in even steps without corners."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from itertools import chain, pairwise
from pathlib import Path
from typing import Any

import pytest
import torch

from bench.cameras import look_at, scale_camera
from bench.motion import between, rotation_between
from bench.trajectories import follow, leading, spline, write_path
from bench.types import Camera, Scene, Split, SteerbenchError

POSE = torch.tensor([[1.0, 0, 0, 0.5], [0, -1, 0, 0.25], [0, 0, -1, 2.0]])


@pytest.fixture
def scene() -> Scene:
    """Four data set units to a scene unit, the corner of the cube at (-1, -2, 0)."""
    camera = Camera(POSE, 40.0, 40.0, 16.0, 12.0, 32, 24)
    image = torch.zeros(24, 32, 3, dtype=torch.uint8)
    split = Split([camera], [image], ["0"])
    bounds = torch.tensor([[0.0, 0, 0], [1, 1, 1]])
    origin = torch.tensor([-1.0, -2.0, 0.0])
    splits = {"train": split, "test": split}
    return Scene("cube", splits, torch.ones(3), bounds, 4.0, "cube", origin)


def keyframe(**others: Any) -> dict[str, Any]:
    flat = [1.0, 0, 0, 3.0, 0, 1, 0, 0, 0, 0, 1, 8, 0, 0, 0, 1]
    return {"camera_to_world": flat, "fov": 90.0} | others


def stored(folder: Path, record: Any, name: str = "path.json") -> str:
    (folder / name).write_text(json.dumps(record))
    return str(folder / name)


def viewer(*keyframes: dict[str, Any]) -> dict[str, Any]:
    return {"render_width": 40, "render_height": 30, "camera_path": list(keyframes)}


def test_a_path_comes_back_as_it_was_written(scene: Scene, tmp_path: Path) -> None:
    first = scene.splits["test"].cameras[0]
    second = replace(first, c2w=first.c2w + torch.tensor([0.0, 0, 0, 0.125]))
    write_path(tmp_path / "there.json", [first, second], scene)
    trajectory = follow(scene, str(tmp_path / "there.json"))
    assert trajectory.name == "there"
    assert trajectory.reads == (tmp_path / "there.json",)
    assert trajectory.preceding == [0, 1]
    for step, camera in zip(trajectory.steps, (first, second), strict=True):
        assert step.truth is None
        torch.testing.assert_close(step.camera.c2w, camera.c2w)
        assert (step.camera.width, step.camera.height) == (32, 24)
        assert step.camera.fy == pytest.approx(camera.fy)


def test_a_key_frame_of_the_viewer_is_read_as_nerfstudio_means_it(
    scene: Scene, tmp_path: Path
) -> None:
    (step,) = follow(scene, stored(tmp_path, viewer(keyframe()))).steps
    camera = step.camera
    # 90 degrees from top to bottom: the focal length is half the height. y and z change signs.
    assert (camera.fx, camera.fy) == pytest.approx((15, 15))
    expected = torch.tensor([[1.0, 0, 0, 1.0], [0, -1, 0, 0.5], [0, 0, -1, 2.0]])
    torch.testing.assert_close(camera.c2w, expected)  # (3, 0, 8) of the data set


def test_a_transforms_file_gives_intrinsics_or_leaves_them_to_the_test_camera(
    scene: Scene, tmp_path: Path
) -> None:
    pose = [[1.0, 0, 0, 3], [0, 1, 0, 0], [0, 0, 1, 8], [0, 0, 0, 1]]
    given = {"fl_x": 30.0, "fl_y": 31.0, "cx": 9.0, "cy": 14.0}
    usual = replace(scene.splits["test"].cameras[0], fy=44.0, cx=15.0)
    split = replace(scene.splits["test"], cameras=[usual])
    scene = replace(scene, splits={**scene.splits, "test": split})
    for record, wanted in (
        (given, (30, 31, 9, 14)),
        ({}, (40, 44, 15, 12)),
        ({"w": 64, "h": 48}, (80, 88, 30, 24)),  # of twice the size
        ({"fl_x": 30.0}, (30, 30, 15, 12)),  # pixels are square where one length is given
        ({"camera_angle_x": 2 * math.atan(1), "w": 20}, (10, 10, 9.375, 12)),
    ):
        path = stored(tmp_path, record | {"frames": [{"transform_matrix": pose}] * 3})
        first, _ = (step.camera for step in follow(scene, path, limit=2).steps)
        assert (first.fx, first.fy, first.cx, first.cy) == pytest.approx(wanted)


@pytest.mark.parametrize(
    ("record", "message"),
    [
        (viewer(), r"camera_path: expected a list with at least one entry, got list of 0"),
        ({"camera_path": [{}]}, r"render_width: expected a whole number"),
        (viewer(keyframe(fov=200)), r"camera_path\[0\]\.fov: expected a finite number above 0"),
        (viewer(keyframe(camera_to_world=[1, 2])), r"camera_to_world: expected 16 numbers"),
        (
            viewer(keyframe(camera_to_world=[2.0, *keyframe()["camera_to_world"][1:]])),
            "expected an orthonormal rotation",
        ),
        ({"nothing": 1}, "frames: expected a list with at least one entry, got nothing"),
    ],
)
def test_a_damaged_path_is_named_with_what_was_expected(
    scene: Scene, tmp_path: Path, record: dict, message: str
) -> None:
    with pytest.raises(SteerbenchError, match=message):
        follow(scene, stored(tmp_path, record))
    with pytest.raises(SteerbenchError, match=r"gone\.json: expected a file, got nothing there"):
        follow(scene, str(tmp_path / "gone.json"))


def moved(camera: Camera, along: float) -> Camera:
    return replace(camera, c2w=camera.c2w + torch.tensor([0.0, 0, 0, along]))


def test_the_keys_of_a_spline_are_a_splits_cameras_or_those_of_a_file(
    scene: Scene, tmp_path: Path
) -> None:
    first = scene.splits["test"].cameras[0]
    cameras = [moved(first, 0.1 * index) for index in range(5)]
    images = scene.splits["test"].images * 5
    splits = scene.splits | {"test": Split(cameras, images, list("abcde"))}
    scene = replace(scene, splits=splits)
    of_split = spline(scene, None, keys=3)
    assert [step.truth for step in of_split.steps if step.truth is not None] == [0, 2, 4]
    assert of_split.preceding[-1] == len(of_split.steps) - 1 > 2
    assert of_split.name == "test-3of5-spline1deg"
    write_path(tmp_path / "keys.json", cameras[:2], scene)
    of_file = spline(scene, str(tmp_path / "keys.json"))
    assert len(of_file.steps) > 2
    assert {step.truth for step in of_file.steps} == {None}
    assert of_file.reads == (tmp_path / "keys.json",)


@pytest.mark.parametrize(("option", "value"), [("degrees", 0.0), ("keys", 1)])
def test_a_spline_refuses_what_is_no_path(scene: Scene, option: str, value: float) -> None:
    with pytest.raises(SteerbenchError, match=f"trajectory.{option}: expected"):
        spline(scene, None, **{option: value})


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

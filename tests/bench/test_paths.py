"""Files of paths are read as their tools mean them, and come back as they were written."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from bench.paths import read_path, write_path
from bench.types import Camera, Scene, Split, SteerbenchError


@pytest.fixture
def scene(tiny_scene) -> Scene:
    """Four data set units to a scene unit, the corner of the cube at (-1, -2, 0)."""
    pose = torch.tensor([[1.0, 0, 0, 0.5], [0, -1, 0, 0.25], [0, 0, -1, 2.0]])
    camera = Camera(pose, 40.0, 40.0, 16.0, 12.0, 32, 24)
    split = Split([camera], [torch.zeros(24, 32, 3, dtype=torch.uint8)], ["0"])
    origin = torch.tensor([-1.0, -2.0, 0.0])
    return replace(tiny_scene, splits={"test": split}, unit_length=4.0, origin=origin)


def keyframe(**others: Any) -> dict[str, Any]:
    flat = [1.0, 0, 0, 3.0, 0, 1, 0, 0, 0, 0, 1, 8, 0, 0, 0, 1]
    return {"camera_to_world": flat, "fov": 90.0} | others


def stored(folder: Path, record: Any) -> Path:
    (folder / "path.json").write_text(json.dumps(record))
    return folder / "path.json"


def viewer(*keyframes: dict[str, Any]) -> dict[str, Any]:
    return {"render_width": 40, "render_height": 30, "camera_path": list(keyframes)}


def nerfbaselines(**others: Any) -> dict[str, Any]:
    about = {"format": "nerfbaselines-v1", "camera_model": "pinhole", "image_size": [40, 30]}
    return about | others


@pytest.mark.parametrize(
    ("asked", "lens"), [(True, {}), (False, {}), (False, {"cx": 9.0, "fx": 30.0})]
)
def test_a_path_comes_back_as_it_was_written(scene, tmp_path, asked, lens):
    first = replace(scene.splits["test"].cameras[0], **lens)
    second = replace(first, c2w=first.c2w + torch.tensor([0.0, 0, 0, 0.125]))
    write_path(tmp_path / "there.json", [first, second], scene, nerfbaselines=asked)
    read = read_path(tmp_path / "there.json", scene)
    for camera, written in zip(read, (first, second), strict=True):
        torch.testing.assert_close(camera.c2w, written.c2w)
        assert (camera.width, camera.height) == (32, 24)
        found, wanted = ((c.fx, c.fy, c.cx, c.cy) for c in (camera, written))
        assert found == pytest.approx(wanted)


def test_a_key_frame_of_the_viewer_is_read_as_nerfstudio_means_it(scene, tmp_path):
    (camera,) = read_path(stored(tmp_path, viewer(keyframe())), scene)
    # 90 degrees from top to bottom: the focal length is half the height. y and z change signs.
    assert (camera.fx, camera.fy) == pytest.approx((15, 15))
    expected = torch.tensor([[1.0, 0, 0, 1.0], [0, -1, 0, 0.5], [0, 0, -1, 2.0]])
    torch.testing.assert_close(camera.c2w, expected)  # (3, 0, 8) of the data set


def test_a_transforms_file_gives_intrinsics_or_leaves_them_to_the_test_camera(scene, tmp_path):
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
        path = stored(tmp_path, record | {"frames": [{"transform_matrix": pose}] * 2})
        first, _ = read_path(path, scene)
        assert (first.fx, first.fy, first.cx, first.cy) == pytest.approx(wanted)


@pytest.mark.parametrize(
    ("record", "message"),
    [
        (viewer(), r"camera_path: expected a list with at least one entry, got list of 0"),
        ({"camera_path": [{}]}, r"render_width: expected a whole number"),
        (viewer(keyframe()) | {"camera_type": "fisheye"}, "camera_type: expected perspective"),
        (viewer(keyframe(fov=200)), r"camera_path\[0\]\.fov: expected a finite number above 0"),
        (viewer(keyframe(camera_to_world=[1, 2])), r"camera_to_world: expected 16 numbers"),
        (
            viewer(keyframe(camera_to_world=[2.0, *keyframe()["camera_to_world"][1:]])),
            "expected an orthonormal rotation",
        ),
        (nerfbaselines(camera_model="opencv"), "camera_model: expected pinhole, got 'opencv'"),
        (nerfbaselines(image_size=[40]), "image_size: expected 2 numbers"),
        (nerfbaselines(frames=[{"pose": [1.0] * 16}]), r"frames\[0\]\.pose: expected 12 numbers"),
        ({"nothing": 1}, "frames: expected a list with at least one entry, got nothing"),
    ],
)
def test_a_damaged_path_is_named_with_what_was_expected(scene, tmp_path, record, message):
    with pytest.raises(SteerbenchError, match=message):
        read_path(stored(tmp_path, record), scene)
    with pytest.raises(SteerbenchError, match=r"gone\.json: expected a file, got nothing there"):
        read_path(tmp_path / "gone.json", scene)

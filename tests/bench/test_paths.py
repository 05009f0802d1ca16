"""Files of paths are read as their tools mean them, and come back as they were written."""

import math
import re
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from bench.paths import MODEL, read_path, write_path
from bench.scenes.remarks import Remarks
from bench.scenes.transforms import program_maps
from bench.trajectories import follow
from bench.types import Camera, Scene, Split
from tests.bench.scenes.conftest import intrinsics
from tests.common import assert_near, refusal, write_json


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
    write_json(folder / "path.json", record)
    return folder / "path.json"


def viewer(*keyframes: dict[str, Any]) -> dict[str, Any]:
    return {"render_width": 40, "render_height": 30, "camera_path": list(keyframes)}


def nerfbaselines(**others: Any) -> dict[str, Any]:
    about = {"format": "nerfbaselines-v1", "camera_model": "pinhole", "image_size": [40, 30]}
    return about | others


FAR = torch.tensor([500_000.3, 5_000_000.7, 0], dtype=torch.float64)


@pytest.mark.parametrize("shift", [0 * FAR, FAR])
@pytest.mark.parametrize(
    ("asked", "lens"), [(True, {}), (False, {}), (False, {"cx": 9.0, "fx": 30.0})]
)
def test_a_path_comes_back_as_it_was_written(scene, tmp_path, asked, lens, shift):
    scene = replace(scene, origin=scene.origin + shift)
    first = replace(scene.splits["test"].cameras[0], **lens)
    second = replace(first, c2w=first.c2w + torch.tensor([0.0, 0, 0, 0.125]))
    write_path(tmp_path / "there.json", [first, second], scene, nerfbaselines=asked)
    read = read_path(tmp_path / "there.json", scene, Remarks())
    for camera, written in zip(read, (first, second), strict=True):
        torch.testing.assert_close(camera.c2w, written.c2w)
        assert (camera.width, camera.height) == (32, 24)
        assert intrinsics(camera) == pytest.approx(intrinsics(written))


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
        first, _ = read_path(path, scene, Remarks())
        assert intrinsics(first) == pytest.approx(wanted)


@pytest.mark.parametrize(
    ("record", "message"),
    [
        (viewer(), r"camera_path: expected a list with at least one entry, got list of 0"),
        ({"camera_path": [{}]}, r"camera_to_world: expected a 4x4 matrix"),
        (viewer(keyframe()) | {"camera_type": "fisheye"}, "camera_type: expected perspective"),
        (viewer(keyframe(fov=200)), r"camera_path\[0\]\.fov: expected a finite number above 0"),
        (viewer(keyframe()) | {"render_width": 0}, r"render_width: expected a whole number"),
        (nerfbaselines(camera_model="opencv", frames=[{}]), "camera_model: expected pinhole, got"),
        (nerfbaselines(image_size=[40], frames=[{}]), "image_size: expected 2 numbers"),
        (nerfbaselines(frames=[{"pose": [1.0] * 9}]), r"frames\[0\]\.pose: expected a 4x4"),
        ({"nothing": 1}, r"expected camera_path \(nerfstudio's viewer\); frames .* got nothing"),
        ({"path": [{"R": [0] * 4, "T": [0] * 3}]}, r"R: its length: expected .* above 0, got 0"),
        ([{"position": [0] * 3, "rotation": [1]}], r"expected a position and three rows of a rot"),
    ],
)
def test_a_damaged_path_is_named_with_what_was_expected(scene, tmp_path, record, message):
    with refusal(message):
        read_path(stored(tmp_path, record), scene, Remarks())
    with refusal(r"gone\.json: expected a file, got no"):
        read_path(tmp_path / "gone.json", scene, Remarks())


TURN = Rotation.from_euler("xyz", (0.3, -0.5, 0.7)).as_matrix()
POSE = torch.from_numpy(TURN @ np.diag((1.0, -1, -1))), torch.tensor([[3.0], [1], [8]]).double()
"""Rotation and centre of a camera, OpenCV axes, in the coordinates of the data set."""

UPRIGHT = torch.tensor([[0, 0, 1.0, 0], [1, 0, 0, 2], [0, 1, 0, 3], [0, 0, 0, 1]]).double()
ORIENTED = torch.tensor([[0, 1.0, 0, 7], [-1, 0, 0, 8], [0, 0, 1, 9], [0, 0, 0, 1]]).double()
SAVED = {"transform": (ORIENTED @ UPRIGHT)[:3].tolist(), "scale": 0.25}
"""As nerfstudio saves it: from where poses were before `UPRIGHT` was applied to them."""


def in_a_model() -> list[list[float]]:
    """`POSE` as nerfstudio has it, OpenGL axes: 4x4, oriented, centres scaled."""
    turn, centre = POSE
    pose = ORIENTED @ torch.cat((torch.cat((turn, centre), 1), UPRIGHT[3:]))
    return (pose * torch.tensor([[1, -1, -1, 0.25]] * 3 + [[1] * 4])).tolist()


def in_the_cube() -> dict[str, Any]:
    """`POSE` as instant-ngp has it: 0.5 x + (0.1, 0.2, 0.3), axes in turn."""
    turn, centre = POSE
    place = 0.5 * centre[:, 0] + torch.tensor([0.1, 0.2, 0.3])
    quaternion = Rotation.from_matrix(turn[[1, 2, 0]].numpy()).as_quat().tolist()
    return {"R": quaternion, "T": place[[1, 2, 0]].tolist(), "fov": 90.0, "slice": 0.5}


def listed() -> dict[str, Any]:
    """`POSE` as 3D Gaussian Splatting has it."""
    pose = {"position": POSE[1][:, 0].tolist(), "rotation": POSE[0].tolist()}
    return pose | {"id": 1, "width": 40, "height": 30, "fx": 20.0, "fy": 21.0}


MOVED = keyframe(camera_to_world=[*chain(*in_a_model())])
STILL = keyframe(camera_to_world=(torch.cat(POSE, 1) * torch.tensor([1, -1, -1, 1])).tolist())


@pytest.mark.parametrize(
    ("record", "fy", "said"),
    [
        (viewer(MOVED), 15, "those of a model, moved back as"),  # 90 degrees from top to bottom
        (viewer(STILL), 15, "those of the data set"),
        ({"loop": True, "path": [in_the_cube()]}, 12, "not read: slice$"),
        ([listed()], 21, "^$"),
    ],
)
def test_poses_in_coordinates_of_other_programs_come_back(scene, tmp_path, record, fy, said):
    cube = program_maps(tmp_path, {"scale": 0.5, "offset": [0.1, 0.2, 0.3]})["instant-ngp"]
    scene = replace(scene, maps={"instant-ngp": cube, "nerfstudio": UPRIGHT})
    write_json(tmp_path / MODEL, SAVED)
    remarks, lines = Remarks(), list[str]()
    (camera,) = read_path(stored(tmp_path, record), scene, remarks)
    turn, centre = POSE
    expected = torch.cat((turn, (centre - scene.origin[:, None]) / 4), 1)
    assert_near(camera.c2w, expected.float(), atol=1e-6)
    assert camera.fy == pytest.approx(fy)
    remarks.tell(lines.append)
    assert re.search(said, "\n".join(lines))


def test_a_model_is_told_or_asked_for(scene, tmp_path):
    file, model = stored(tmp_path, viewer(MOVED)), tmp_path / "model.json"
    write_json(model, SAVED)
    asked = follow(scene, str(file))
    assert asked.notes[0].endswith("or trajectory.transforms=FILE")
    centre = (torch.tensor(in_a_model())[:3, 3] - scene.origin) / 4  # poses as they are
    torch.testing.assert_close(asked.steps[0].camera.c2w[:, 3], centre)
    told = follow(scene, str(file), transforms=str(model))
    assert told.reads == (file, model)
    assert "moved back as" in told.notes[0]

"""Reads camera paths from nerfstudio's viewer and from a `transforms.json`; writes the former.

Poses are camera-to-world in the coordinates of the data set, OpenGL axes (y up, z backward).
"""

from __future__ import annotations

import json
import math
from collections import ChainMap
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from bench.cameras import move_camera
from bench.motion import viewing_target
from bench.scenes.files import (
    describe,
    number,
    opengl_pose,
    opengl_to_opencv,
    read_json,
    rigid_pose,
    unexpected,
    whole_number,
)
from bench.scenes.transforms import focal
from bench.splines import leading
from bench.trajectories import Step, Trajectory, from_split
from bench.types import Camera, Scene, SteerbenchError

KEYFRAMES = "camera_path"
"""The name under which a file of nerfstudio's viewer lists its cameras."""


def follow(scene: Scene, path: str, limit: int = 0) -> Trajectory:
    """The cameras of a file, in order and without ground truth.

    nerfstudio's file has a list `camera_path`, each entry with a `camera_to_world` of 16 numbers
    row by row and a vertical `fov` in degrees; `render_width` and `render_height` hold for all. A
    `transforms.json` has `frames`; missing intrinsics are taken from the first test camera.

    Args:
        path: the file.
        limit: if > 0, keep only the first `limit` cameras.

    Raises:
        SteerbenchError: the file is damaged or has no cameras; a pose is not rigid.
    """
    file = Path(path).expanduser().resolve()
    record = read_json(file.parent, file.name)
    cameras = _of_viewer(record, file) if KEYFRAMES in record else _of_frames(record, file, scene)
    whole_number(limit, "trajectory.limit", 0)
    scale, offset = 1 / scene.unit_length, -scene.origin.double() / scene.unit_length
    moved = [move_camera(camera, scale, offset) for camera in cameras[: limit or None]]
    steps = tuple(Step(camera, truth=None) for camera in moved)
    return Trajectory(file.stem, "test", steps, reads=(file,))


def spline(
    scene: Scene, path: str | None, split: str = "test", keys: int = 6, degrees: float = 1.0
) -> Trajectory:
    """A smooth path through a few key cameras; see `splines.leading`.

    Args:
        path: a file of cameras, as `follow` reads it; all of them are keys. None: the keys are
            cameras of the scene.
        split: the split these keys come from. Only they have ground truth.
        keys: how many, evenly spread over the split.
        degrees: largest step from frame to frame.

    Raises:
        SteerbenchError: as `follow`; as `from_split`; `degrees` is not positive; fewer than two
            keys, two consecutive keys with the same pose, or their pictures differ in size.
    """
    if not degrees > 0:
        raise SteerbenchError(f"trajectory.degrees: expected more than 0, got {degrees}")
    whole_number(keys, "trajectory.keys", 2)
    through = follow(scene, path) if path else from_split(scene, split, keys)
    first, *others = through.steps
    cameras = [step.camera for step in through.steps]
    pieces = leading(cameras, viewing_target(scene), degrees)
    steps = [first]
    for key, piece in zip(others, pieces, strict=True):
        steps += [*(Step(camera, truth=None) for camera in piece[:-1]), replace(key, cut=False)]
    name = f"{through.name}-spline{degrees:g}deg"
    return Trajectory(name, through.split, tuple(steps), through.reads)


def write(path: Path, cameras: Sequence[Camera], scene: Scene, fps: float = 30.0) -> None:
    """Write `cameras` (scene units, all of one size) as a path that nerfstudio's viewer reads."""
    first = cameras[0]
    record = {
        "camera_type": "perspective",
        "render_width": first.width,
        "render_height": first.height,
        "fps": fps,
        "seconds": len(cameras) / fps,
        KEYFRAMES: [_keyframe(camera, scene) for camera in cameras],
    }
    path.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


def _keyframe(camera: Camera, scene: Scene) -> dict[str, Any]:
    moved = move_camera(camera, scene.unit_length, scene.origin)
    pose = opengl_to_opencv(moved.c2w.double())  # its own inverse: it flips two axes
    rows = torch.cat((pose, pose.new_tensor([[0, 0, 0, 1]])))
    return {
        "camera_to_world": rows.flatten().tolist(),
        "fov": math.degrees(2 * math.atan(camera.height / 2 / camera.fy)),
        "aspect": camera.width / camera.height,
    }


def _of_viewer(record: dict, file: Path) -> list[Camera]:
    """The cameras of nerfstudio's file: square pixels, principal point at the centre."""
    width, height = (whole_number(record.get(k), f"{file}: {k}", 1) for k in _SIZE)
    found = []
    for where, entry in _entries(record, KEYFRAMES, file):
        flat = entry.get("camera_to_world")
        if not isinstance(flat, list) or len(flat) != 16:
            raise unexpected(f"{where}.camera_to_world", "16 numbers", describe(flat))
        rows = [flat[row : row + 4] for row in range(0, 16, 4)]
        pose = opengl_to_opencv(rigid_pose(rows, f"{where}.camera_to_world"))
        angle = number(entry.get("fov", record.get("default_fov")), f"{where}.fov", 0, 180)
        length = height / 2 / math.tan(math.radians(angle) / 2)
        found.append(_camera(pose, length, length, width, height))
    return found


_SIZE = ("render_width", "render_height")


def _of_frames(record: dict, file: Path, scene: Scene) -> list[Camera]:
    """The cameras of a `transforms.json`, with or without pictures."""
    usual = scene.splits["test"].cameras[0]
    found = []
    for where, frame in _entries(record, "frames", file):
        settings = ChainMap(frame, record)
        width = whole_number(settings.get("w", usual.width), f"{where}.w", 1)
        height = whole_number(settings.get("h", usual.height), f"{where}.h", 1)
        given = focal(settings, "x", width, where)
        fx = given or usual.fx * width / usual.width
        fy = focal(settings, "y", height, where) or given or usual.fy * height / usual.height
        centre = usual.cx * width / usual.width, usual.cy * height / usual.height
        cx, cy = (
            number(settings.get(name, value), f"{where}.{name}", 0, most)
            for name, value, most in zip(("cx", "cy"), centre, (width, height), strict=True)
        )
        found.append(Camera(opengl_pose(frame, where), fx, fy, cx, cy, width, height))
    return found


def _entries(record: dict, name: str, file: Path) -> list[tuple[str, dict]]:
    """The objects of the list `name` in the file, each with its position for error messages."""
    entries = record.get(name)
    if not isinstance(entries, list) or not entries:
        raise unexpected(f"{file}: {name}", "a list with at least one camera", describe(entries))
    for index, entry in enumerate(entries):
        if not isinstance(entry, dict):
            raise unexpected(f"{file}: {name}[{index}]", "an object", describe(entry))
    return [(f"{file}: {name}[{index}]", entry) for index, entry in enumerate(entries)]


def _camera(pose: Tensor, fx: float, fy: float, width: int, height: int) -> Camera:
    return Camera(pose, fx, fy, width / 2, height / 2, width, height)

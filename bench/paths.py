"""Camera paths: from files of nerfstudio's viewer and `transforms.json`, and through key cameras.

Poses in files are camera-to-world, in the coordinates of the data set, with OpenGL axes.
"""

from __future__ import annotations

import json
import math
from collections import ChainMap
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline
from torch import Tensor

from bench.cameras import move_camera
from bench.errors import unexpected
from bench.motion import lens_between, viewing_target
from bench.scenes.files import (
    describe,
    entries_of,
    number,
    opengl_pose,
    opengl_to_opencv,
    read_json,
    rigid_pose,
    whole_number,
)
from bench.scenes.transforms import read_camera
from bench.trajectories import Step, Trajectory, from_split
from bench.types import Camera, Scene

SAMPLES = 65
"""Poses per segment for measuring its length: 64 chords of half a circle are 0.01 % too short."""

KEYFRAMES = "camera_path"  # under which a file of nerfstudio's viewer lists its cameras


def follow(scene: Scene, path: str, limit: int = 0) -> Trajectory:
    """The first `limit` cameras of a file (0: all), in order and without ground truth.

    nerfstudio's file has a list `camera_path`, each entry with a `camera_to_world` of 16 numbers
    row by row and a vertical `fov` in degrees; `render_width` and `render_height` hold for all. A
    `transforms.json` has `frames`; missing intrinsics are taken from the first test camera.

    Raises SteerbenchError if the file is damaged or has no cameras, or a pose is not rigid.
    """
    file = Path(path).expanduser().resolve()
    record = read_json(file.parent, file.name)
    if KEYFRAMES in record:
        cameras = _of_viewer(record, file)
    else:
        usual = scene.splits["test"].cameras[0]
        cameras = [
            read_camera(ChainMap(frame, record), opengl_pose(frame, where), usual, where)
            for where, frame in entries_of(record, "frames", file)
        ]
    whole_number(limit, "trajectory.limit", 0)
    scale, offset = 1 / scene.unit_length, -scene.origin.double() / scene.unit_length
    moved = [move_camera(camera, scale, offset) for camera in cameras[: limit or None]]
    steps = tuple(Step(camera, truth=None) for camera in moved)
    return Trajectory(file.stem, "test", steps, reads=(file,))


def spline(
    scene: Scene, path: str | None, split: str = "test", keys: int = 6, degrees: float = 1.0
) -> Trajectory:
    """A smooth path through a few key cameras, in steps of at most `degrees`; see `leading`.

    All cameras of the file `path` are keys, see `follow`; without a file, so many `keys` are evenly
    spread over the `split`, and only they have ground truth. Raises SteerbenchError as `follow`,
    `from_split` and `leading` do.
    """
    if not degrees > 0:
        raise unexpected("trajectory.degrees", "more than 0", degrees)
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
    first, keyframes = cameras[0], []
    for camera in cameras:
        moved = move_camera(camera, scene.unit_length, scene.origin)
        pose = opengl_to_opencv(moved.c2w.double())  # its own inverse: it flips two axes
        fov = math.degrees(2 * math.atan(camera.height / 2 / camera.fy))
        flat = [*pose.flatten().tolist(), 0.0, 0.0, 0.0, 1.0]
        aspect = camera.width / camera.height
        keyframes.append({"camera_to_world": flat, "fov": fov, "aspect": aspect})
    record = {
        "camera_type": "perspective",
        "render_width": first.width,
        "render_height": first.height,
        "fps": fps,
        "seconds": len(cameras) / fps,
        KEYFRAMES: keyframes,
    }
    path.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


def _of_viewer(record: dict, file: Path) -> list[Camera]:
    """The cameras of nerfstudio's file: square pixels, principal point at the centre."""
    width, height = (
        whole_number(record.get(k), f"{file}: {k}", 1) for k in ("render_width", "render_height")
    )
    cameras = []
    for where, entry in entries_of(record, KEYFRAMES, file):
        flat = entry.get("camera_to_world")
        if not isinstance(flat, list) or len(flat) != 16:
            raise unexpected(f"{where}.camera_to_world", "16 numbers", describe(flat))
        rows = [flat[row : row + 4] for row in range(0, 16, 4)]
        pose = opengl_to_opencv(rigid_pose(rows, f"{where}.camera_to_world"))
        angle = number(entry.get("fov", record.get("default_fov")), f"{where}.fov", 0, 180)
        focal = height / 2 / math.tan(math.radians(angle) / 2)
        cameras.append(Camera(pose, focal, focal, width / 2, height / 2, width, height))
    return cameras


def leading(keys: Sequence[Camera], target: Tensor, degrees: float) -> list[list[Camera]]:
    """A smooth path through `keys`, one segment for each key but the first.

    A segment holds the cameras after the previous key, up to and including its own, evenly spaced
    by at most `degrees`. Centres follow a cubic spline, rotations one with continuous angular
    acceleration, both by length: the angle of the camera's rotation or of its centre's motion as
    seen from `target` [3], whichever is larger.

    Raises SteerbenchError if there are fewer than two keys, two consecutive keys with the same
    pose, or keys whose pictures differ in size.
    """
    poses = torch.stack([camera.c2w.double() for camera in keys]).numpy()
    turns, centres = Rotation.from_matrix(poses[:, :, :3]), poses[:, :, 3]
    lengths = _lengths(turns, centres, target)
    if not (len(lengths) and lengths.min() > 0):
        raise unexpected("spline", "two cameras or more", "fewer, or one at the pose before it")
    knots = np.concatenate(([0.0], lengths.cumsum()))
    turning, moving = RotationSpline(knots, turns), CubicSpline(knots, centres)
    pieces = []
    for (first, second), (start, end) in zip(pairwise(keys), pairwise(knots), strict=True):
        fine = np.linspace(start, end, SAMPLES)
        gone = np.concatenate(([0.0], _lengths(turning(fine), moving(fine), target).cumsum()))
        count = max(math.ceil(math.degrees(gone[-1]) / degrees - 1e-3), 1)
        at = np.interp(np.linspace(0, gone[-1], count + 1)[1:-1], gone, fine)
        piece = []
        for time in at:
            camera = lens_between(first, second, float((time - start) / (end - start)))
            pose = np.column_stack((turning(time).as_matrix(), moving(time)))
            piece.append(replace(camera, c2w=torch.from_numpy(pose).to(first.c2w)))
        pieces.append([*piece, second])
    return pieces


def _lengths(turns: Rotation, centres: np.ndarray, target: Tensor) -> np.ndarray:
    """The length [N - 1] in radians from each of N poses to the next; see `leading`."""
    moved = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    far = np.linalg.norm(centres - target.double().numpy(), axis=1)
    return np.maximum((turns[:-1].inv() * turns[1:]).magnitude(), np.arctan2(moved, far[:-1]))

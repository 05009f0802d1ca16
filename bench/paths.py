"""Paths of cameras in files of other tools: reads and writes them.

Poses in such files (of nerfstudio's viewer, `transforms.json`) are camera-to-world in the data
set's coordinates, with OpenGL axes; NerfBaselines' have OpenCV's.
"""

import json
import math
from collections import ChainMap
from collections.abc import Sequence
from pathlib import Path

import torch

from bench.cameras import move_camera
from bench.errors import unexpected
from bench.scenes.export import data_camera
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
from bench.types import Camera, Scene

KEYFRAMES = "camera_path"  # under which a file of nerfstudio's viewer lists its cameras
NERFBASELINES = "nerfbaselines-v1"  # the `format` of a path of NerfBaselines


def read_path(file: Path, scene: Scene) -> list[Camera]:
    """The cameras of a file, in order, in the units of `scene`; at least one.

    nerfstudio's file has a list `camera_path`, each entry with a `camera_to_world` of 16 numbers
    row by row and a vertical `fov` in degrees; `render_width` and `render_height` hold for all. A
    `transforms.json` has `frames`; missing intrinsics are taken from the first test camera. That of
    NerfBaselines has `frames`, too, and `format` nerfbaselines-v1: each with a `pose` of 12 numbers
    row by row, in OpenCV axes, and `intrinsics` fx, fy, cx, cy; `image_size` holds for all.

    Raises SteerbenchError if the file is damaged or has no cameras, or a pose is not rigid.
    """
    record = read_json(file.parent, file.name)
    if KEYFRAMES in record:
        cameras = _of_viewer(record, file)
    elif record.get("format") == NERFBASELINES:
        cameras = _of_nerfbaselines(record, file)
    else:
        cameras = []
        for where, frame in entries_of(record, "frames", file):
            settings, pose = ChainMap(frame, record), opengl_pose(frame, where)
            cameras.append(read_camera(settings, pose, _usual(settings, scene, where), where))
    scale, offset = 1 / scene.unit_length, -scene.origin.double() / scene.unit_length
    return [move_camera(camera, scale, offset) for camera in cameras]


def _usual(settings: ChainMap, scene: Scene, where: str) -> Camera:
    """The camera that has what the `settings` of a frame lack."""
    if scene.splits:
        return scene.splits["test"].cameras[0]
    if not {"w", "h"} <= settings.keys():
        raise unexpected(
            where, "w and h, or scene=..., whose first test camera has them", "neither"
        )
    return Camera(torch.eye(4)[:3], 0, 0, 0.5, 0.5, 1, 1)


def _of_viewer(record: dict, file: Path) -> list[Camera]:
    """The cameras of nerfstudio's file: square pixels, principal point at the centre."""
    if (kind := record.get("camera_type", "perspective")) != "perspective":
        raise unexpected(f"{file}: camera_type", "perspective", describe(kind))
    width, height = (
        whole_number(record.get(k), f"{file}: {k}", 1) for k in ("render_width", "render_height")
    )
    cameras = []
    for where, entry in entries_of(record, KEYFRAMES, file):
        flat = _numbers(entry.get("camera_to_world"), 16, f"{where}.camera_to_world")
        rows = [flat[row : row + 4] for row in range(0, 16, 4)]
        pose = opengl_to_opencv(rigid_pose(rows, f"{where}.camera_to_world"))
        angle = number(entry.get("fov", record.get("default_fov")), f"{where}.fov", 0, 180)
        focal = height / 2 / math.tan(math.radians(angle) / 2)
        cameras.append(Camera(pose, focal, focal, width / 2, height / 2, width, height))
    return cameras


def _of_nerfbaselines(record: dict, file: Path) -> list[Camera]:
    """The cameras of a path of NerfBaselines; appearances are ignored."""
    if record.get("camera_model") != "pinhole":
        raise unexpected(f"{file}: camera_model", "pinhole", describe(record.get("camera_model")))
    size = _numbers(record.get("image_size"), 2, f"{file}: image_size")
    width, height = (whole_number(x, f"{file}: image_size", 1) for x in size)
    cameras = []
    for where, frame in entries_of(record, "frames", file):
        flat = _numbers(frame.get("pose"), 12, f"{where}.pose")
        pose = rigid_pose([flat[row : row + 4] for row in (0, 4, 8)], f"{where}.pose")
        lens = _numbers(frame.get("intrinsics"), 4, f"{where}.intrinsics")
        fx, fy, cx, cy = (number(x, f"{where}.intrinsics", 0) for x in lens)
        cameras.append(Camera(pose, fx, fy, cx, cy, width, height))
    return cameras


def _numbers(value: object, count: int, where: str) -> list:
    if not isinstance(value, list) or len(value) != count:
        raise unexpected(where, f"{count} numbers", describe(value))
    return value


def write_path(
    path: Path,
    cameras: Sequence[Camera],
    scene: Scene,
    fps: float = 30.0,
    nerfbaselines: bool = False,
) -> None:
    """Write `cameras` (scene units, all of one size) as a path that nerfstudio's viewer reads; as
    one of NerfBaselines if that is asked for, or the viewer has no words for a lens."""
    moved = [data_camera(scene, camera) for camera in cameras]
    form = _nerfbaselines if nerfbaselines or not all(map(_plain, cameras)) else _viewers
    record = form(moved, fps)
    path.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


def _plain(camera: Camera) -> bool:
    """Whether pixels are square and the principal point is at the centre."""
    centre = (camera.width / 2, camera.height / 2)
    pairs = ((camera.fx, camera.fy), *zip((camera.cx, camera.cy), centre, strict=True))
    return all(math.isclose(*pair, rel_tol=1e-6) for pair in pairs)


def _viewers(cameras: Sequence[Camera], fps: float) -> dict:
    first, keyframes = cameras[0], []
    for camera in cameras:
        pose = opengl_to_opencv(camera.c2w.double())  # its own inverse: it flips two axes
        fov = math.degrees(2 * math.atan(camera.height / 2 / camera.fy))
        flat = [*pose.flatten().tolist(), 0.0, 0.0, 0.0, 1.0]
        aspect = camera.width / camera.height
        keyframes.append({"camera_to_world": flat, "fov": fov, "aspect": aspect})
    return {
        "camera_type": "perspective",
        "render_width": first.width,
        "render_height": first.height,
        "fps": fps,
        "seconds": len(cameras) / fps,
        KEYFRAMES: keyframes,
    }


def _nerfbaselines(cameras: Sequence[Camera], fps: float) -> dict:
    frames = [
        {
            "pose": camera.c2w.flatten().tolist(),
            "intrinsics": [camera.fx, camera.fy, camera.cx, camera.cy],
            "appearance_weights": [],
        }
        for camera in cameras
    ]
    size = [cameras[0].width, cameras[0].height]
    about = {"format": NERFBASELINES, "camera_model": "pinhole", "image_size": size, "fps": fps}
    return {**about, "source": None, "appearances": [], "frames": frames}

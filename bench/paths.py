"""Paths of cameras in files of other tools: reads and writes them.

Poses are camera-to-world; with OpenGL axes in files of nerfstudio and in a `transforms.json`, with
OpenCV's in those of NerfBaselines, instant-ngp and 3D Gaussian Splatting.
"""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from bench.cameras import move_camera
from bench.errors import unexpected
from bench.records import read_json
from bench.scenes.export import data_camera
from bench.scenes.files import (
    Fields,
    entries_of,
    focal_length,
    matrix,
    number,
    opengl_to_opencv,
    rigid_pose,
    whole_number,
)
from bench.scenes.remarks import Remarks
from bench.scenes.transforms import KNOWN, program_maps, read_camera, read_lens
from bench.types import Camera, Cameras, Scene

KEYFRAMES = "camera_path"  # under which a file of nerfstudio's viewer lists its cameras
OURS = {"coordinates": "data set"}  # in such files that we wrote
MODEL = "dataparser_transforms.json"  # nerfstudio's, beside a model: how it moved the data set
NERFBASELINES = "nerfbaselines-v1"  # the `format` of a path of NerfBaselines
LISTED = "a list"  # names what is in a file that is nothing else

FORMS = {
    KEYFRAMES: "nerfstudio's viewer",
    "frames": "NerfBaselines, or a transforms.json",
    "path": "instant-ngp's base_cam.json",
    LISTED: "3D Gaussian Splatting's cameras.json",
}
"""The files that have a field of that name."""

READ = "; ".join(f"{name} ({form})" for name, form in FORMS.items())

HARMLESS = """coordinates camera_type render_width render_height camera_to_world fov default_fov
    aspect fps seconds is_cycle smoothness_value default_transition_sec keyframes format image_size
    source pose intrinsics R T loop time timestamp spline_order duration_seconds default_t id
    img_name width height position fx fy"""
"""Fields that are read, or do not change what is seen."""


def read_path(
    file: Path, scene: Scene, remarks: Remarks, model: Path | None = None
) -> list[Camera]:
    """The cameras of a file in one of the `FORMS`, in order, in the units of `scene`; at least one.

    The first test camera gives what a `transforms.json` lacks, and the size to key frames of
    instant-ngp. Poses of nerfstudio's viewer are those of a model; what the file `model` says is
    undone. What a user should know is added to `remarks`.
    Raises SteerbenchError if the file is damaged or has no cameras, or a pose is not rigid.
    """
    record = read_json(file, listed=LISTED)
    name = next((name for name in FORMS if name in record), None)
    if name is None:
        raise unexpected(file, READ, ", ".join(record) or "an empty object")
    entries = entries_of(record, name, file)
    remarks.add_unread(file, [record, *entries], {name, *KNOWN, *HARMLESS.split()})
    read = dict(zip(FORMS, (_of_viewer, _of_frame, _of_ngp, _of_splatting), strict=True))[name]
    usual = scene.splits["test"].cameras[0] if scene.splits else None
    cameras = [read(entry, remarks, usual) for entry in entries]
    if name == "path":
        cube = (scene.maps or program_maps(file, {}))["instant-ngp"]
        cameras = _moved(cameras, cube, file)
    elif name == KEYFRAMES and not record.items() >= OURS.items():
        cameras = _out_of_model(cameras, file, scene, remarks, model)
    scale = 1 / scene.unit_length
    offset = -scene.origin.double() / scene.unit_length
    return [move_camera(camera, scale, offset) for camera in cameras]


def _of_viewer(settings: Fields, remarks: Remarks, _: Camera | None) -> Camera:
    if settings.get("camera_type", "perspective") != "perspective":
        raise settings.wrong("camera_type", "perspective")
    pose = opengl_to_opencv(settings.pose("camera_to_world", remarks))
    fov = settings.get("fov", settings.get("default_fov"))
    width, height = settings.size("render_width"), settings.size("render_height")
    return _centred(pose, fov, width, height, settings)


def _of_frame(settings: Fields, remarks: Remarks, usual: Camera | None) -> Camera:
    if settings.get("format") == NERFBASELINES:
        if settings.get("camera_model") != "pinhole":
            raise settings.wrong("camera_model", "pinhole")
        size = settings.numbers("image_size", 2)
        width, height = (whole_number(x, settings.place("image_size"), 1) for x in size)
        pose = settings.pose("pose", remarks)
        fx, fy, cx, cy = settings.numbers("intrinsics", 4)
        fx, fy = (number(x, settings.place("intrinsics"), 0) for x in (fx, fy))
        return Camera(pose, fx, fy, cx, cy, width, height)
    if lens := read_lens(settings):
        remarks.add(settings.where, "a frame of a path is a pinhole's, without its lens", lens)
    pose = opengl_to_opencv(settings.pose("transform_matrix", remarks))
    return read_camera(settings, replace(_known(usual, settings), c2w=pose), remarks)


def _of_ngp(settings: Fields, remarks: Remarks, usual: Camera | None) -> Camera:
    turn = settings.numbers("R", 4)
    number(math.hypot(*turn), settings.place("R: its length"), 0)
    centre = settings.numbers("T", 3)
    pose = np.column_stack((Rotation.from_quat(turn).as_matrix(), centre))
    size = _known(usual, settings).size
    return _centred(torch.from_numpy(pose), settings.get("fov"), *size, settings)


def _of_splatting(settings: Fields, remarks: Remarks, _: Camera | None) -> Camera:
    try:
        rows = zip(settings["rotation"], settings["position"], strict=True)
        pose = rigid_pose([[*row, x] for row, x in rows], settings.where, remarks)
    except (KeyError, TypeError, ValueError) as error:
        expected = f"a position and three rows of a rotation, or a file with {READ}"
        got = f"{', '.join(settings)}: {error}"
        raise unexpected(settings.where, expected, got) from error
    width = settings.size("width")
    height = settings.size("height")
    fx = settings.number("fx", 0)
    fy = settings.number("fy", 0)
    cx = settings.number("cx", usual=width / 2)
    cy = settings.number("cy", usual=height / 2)
    return Camera(pose, fx, fy, cx, cy, width, height)


def _known(usual: Camera | None, settings: Fields) -> Camera:
    """The camera that has what the `settings` of an entry lack."""
    if not usual and not {"w", "h"} <= settings.keys():
        expected = "w and h, or scene=..., whose first test camera has them"
        raise unexpected(settings.where, expected, "neither")
    return usual or Camera(torch.eye(4)[:3], 0, 0, 0.5, 0.5, 1, 1)


def _out_of_model(
    cameras: list[Camera], file: Path, scene: Scene, remarks: Remarks, given: Path | None
) -> list[Camera]:
    """Cameras that nerfstudio wrote, moved back from a model to the data set. A file beside them
    counts if they come so nearer to the cameras of the data set: they do not say what they are."""
    model = given or file.with_name(MODEL)
    if not (given or model.is_file()):
        kind = f"without {MODEL} beside it, poses are taken as the data set's"
        how = "if they are a model's, copy its file there, or trajectory.transforms=FILE"
        remarks.add(file, kind, how)
        return cameras
    saved, forth = read_json(model), torch.eye(4).double()
    forth[:3] = matrix(saved.get("transform"), f"{model}: transform")
    forth[:3] *= number(saved.get("scale"), f"{model}: scale", 0)
    number(torch.linalg.det(forth).abs().item(), f"{model}: determinant", 0)
    before = scene.maps.get("nerfstudio", torch.eye(4).double())
    moved = _moved(cameras, before @ torch.linalg.inv(forth), model)
    there = [data_camera(scene, c) for split in scene.splits.values() for c in split.cameras]

    def far(read: list[Camera]) -> float:
        return torch.cdist(_centres(read), _centres(there)).amin(1).mean().item()

    if not given and there and far(cameras) < far(moved):
        remarks.add(file, "poses are read as", "those of the data set")
        return cameras
    remarks.add(file, "poses are read as", f"those of a model, moved back as {model} says")
    return moved


def _centres(cameras: Cameras) -> Tensor:
    return torch.stack([camera.centre for camera in cameras])


def _moved(cameras: Cameras, move: Tensor, where: Path) -> list[Camera]:
    """The cameras after a similarity [4, 4] moved the world."""
    scale = number(torch.linalg.det(move).item(), f"{where}: determinant", 0) ** (1 / 3)
    moved = []
    for camera in cameras:
        turn, centre = (move[:3, :3] @ part for part in camera.c2w.split((3, 1), dim=1))
        pose = torch.cat((turn / scale, centre + move[:3, 3:]), dim=1)
        moved.append(replace(camera, c2w=pose))
    return moved


def _centred(pose: Tensor, degrees: object, width: int, height: int, settings: Fields) -> Camera:
    """Square pixels, the principal point at the centre, a vertical field of view."""
    where = settings.place("fov")
    focal = focal_length(math.radians(number(degrees, where, 0, 180)), height, where)
    return Camera(pose, focal, focal, width / 2, height / 2, width, height)


def write_path(
    path: Path,
    cameras: Cameras,
    scene: Scene,
    fps: float = 30.0,
    nerfbaselines: bool = False,
) -> None:
    """Write `cameras` (scene units, all of one size) as a path that nerfstudio's viewer reads; as
    one of NerfBaselines if that is asked for, or the viewer has no words for a lens."""
    moved = [data_camera(scene, camera) for camera in cameras]
    form = _nerfbaselines if nerfbaselines or not all(map(_plain, cameras)) else _viewers
    path.write_text(json.dumps(form(moved, fps), indent=1) + "\n", encoding="utf-8")


def _plain(camera: Camera) -> bool:
    """Whether pixels are square and the principal point is at the centre."""
    pairs = ((camera.fx, camera.fy), (2 * camera.cx, camera.width), (2 * camera.cy, camera.height))
    return all(math.isclose(*pair, rel_tol=1e-6) for pair in pairs)


def _viewers(cameras: Cameras, fps: float) -> dict:
    first, keyframes = cameras[0], []
    for camera in cameras:
        pose = opengl_to_opencv(camera.c2w.double())  # its own inverse: it flips two axes
        fov = math.degrees(2 * math.atan(camera.height / 2 / camera.fy))
        flat = [*pose.flatten().tolist(), 0.0, 0.0, 0.0, 1.0]
        aspect = camera.width / camera.height
        keyframes.append({"camera_to_world": flat, "fov": fov, "aspect": aspect})
    return {
        **OURS,
        "camera_type": "perspective",
        "render_width": first.width,
        "render_height": first.height,
        "fps": fps,
        "seconds": len(cameras) / fps,
        KEYFRAMES: keyframes,
    }


def _nerfbaselines(cameras: Cameras, fps: float) -> dict:
    frames = [
        {
            "pose": camera.c2w.flatten().tolist(),
            "intrinsics": [*camera.intrinsics],
            "appearance_weights": [],
        }
        for camera in cameras
    ]
    size = [*cameras[0].size]
    about = {"format": NERFBASELINES, "camera_model": "pinhole", "image_size": size, "fps": fps}
    return {**about, "source": None, "appearances": [], "frames": frames}

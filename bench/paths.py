"""Paths of cameras in files of other tools: reads and writes them.

Poses are camera-to-world; with OpenGL axes in files of nerfstudio and in a `transforms.json`, with
OpenCV's in those of NerfBaselines, instant-ngp and 3D Gaussian Splatting.
"""

import json
import math
from collections import ChainMap
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from bench.cameras import move_camera
from bench.errors import unexpected
from bench.scenes.export import data_camera
from bench.scenes.files import (
    describe,
    entries_of,
    focal_length,
    matrix,
    number,
    opengl_pose,
    opengl_to_opencv,
    read_json,
    rigid_pose,
    whole_number,
)
from bench.scenes.remarks import Remarks
from bench.scenes.transforms import BOX, KNOWN, program_maps, read_camera, read_lens
from bench.types import Camera, Scene

KEYFRAMES = "camera_path"  # under which a file of nerfstudio's viewer lists its cameras
OURS = {"coordinates": "data set"}  # in such files that we wrote
MODEL = "dataparser_transforms.json"  # nerfstudio's, beside a model: how it moved the data set
NERFBASELINES = "nerfbaselines-v1"  # the `format` of a path of NerfBaselines
LISTED = "a list"  # names what is in a file that is nothing else

FORMS = {
    KEYFRAMES: "nerfstudio's viewer",
    "frames": "NerfBaselines, or a transforms.json",
    "path": "instant-ngp's base_cam.json",
    LISTED: "3D Gaussian Splatting's cameras.json, or ns-export",
}
"""The files that have a field of that name."""

HARMLESS = """coordinates camera_type render_width render_height camera_to_world fov default_fov
    aspect fps seconds is_cycle smoothness_value default_transition_sec keyframes format image_size
    source pose intrinsics R T loop time timestamp spline_order duration_seconds default_t id
    img_name width height position transform fx fy"""
"""Fields that are read, or do not change what is seen."""


def read_path(
    file: Path, scene: Scene, remarks: Remarks, model: Path | None = None
) -> list[Camera]:
    """The cameras of a file in one of the `FORMS`, in order, in the units of `scene`; at least one.

    The first test camera gives what a `transforms.json` lacks, all but the pose to ns-export, and
    the size to key frames of instant-ngp. Poses of nerfstudio's viewer and of ns-export are those
    of a model; what the file `model` says is undone. What a user should know is added to `remarks`.
    Raises SteerbenchError if the file is damaged or has no cameras, or a pose is not rigid.
    """
    cameras = _Reader(file, scene, remarks, model).cameras()
    scale, offset = 1 / scene.unit_length, -scene.origin.double() / scene.unit_length
    return [move_camera(camera, scale, offset) for camera in cameras]


class _Reader:
    """Reads the cameras of one file, in the coordinates of the data set."""

    def __init__(self, file: Path, scene: Scene, remarks: Remarks, model: Path | None) -> None:
        self.file, self.scene, self.remarks, self.model = file, scene, remarks, model
        self.record = read_json(file.parent, file.name, LISTED)

    def cameras(self) -> list[Camera]:
        name = next((name for name in FORMS if name in self.record), None)
        if name is None:
            forms = "; ".join(f"{name} ({form})" for name, form in FORMS.items())
            raise unexpected(self.file, forms, ", ".join(self.record) or "an empty object")
        entries = entries_of(self.record, name, self.file)
        levels = [self.record, *(entry for _, entry in entries)]
        self.remarks.add_unread(self.file, levels, {name, *KNOWN, *BOX, *HARMLESS.split()})
        readers = self.of_viewer, self.of_frame, self.of_ngp, self.of_list
        read = dict(zip(FORMS, readers, strict=True))[name]
        cameras = [read(entry, where) for where, entry in entries]
        if name == "path":
            return self.out_of_cube(cameras)
        theirs = name == KEYFRAMES and not self.record.items() >= OURS.items()
        return self.out_of_model(cameras) if theirs or "transform" in entries[0][1] else cameras

    def usual(self, settings: Mapping, where: str) -> Camera:
        """The camera that has what the `settings` of an entry lack."""
        if self.scene.splits:
            return self.scene.splits["test"].cameras[0]
        if not {"w", "h"} <= settings.keys():
            expected = "w and h, or scene=..., whose first test camera has them"
            raise unexpected(where, expected, "neither")
        return Camera(torch.eye(4)[:3], 0, 0, 0.5, 0.5, 1, 1)

    def of_viewer(self, entry: dict, where: str) -> Camera:
        kind = self.record.get("camera_type", "perspective")
        if kind != "perspective":
            raise unexpected(f"{self.file}: camera_type", "perspective", describe(kind))
        size = self.size(self.record, "render_")
        pose = opengl_pose(entry, "camera_to_world", where, self.remarks)
        return _centred(pose, entry.get("fov", self.record.get("default_fov")), size, where)

    def size(self, record: dict, prefix: str = "") -> list[int]:
        names = (f"{prefix}{side}" for side in ("width", "height"))
        return [whole_number(record.get(name), f"{self.file}: {name}", 1) for name in names]

    def of_frame(self, frame: dict, where: str) -> Camera:
        if self.record.get("format") == NERFBASELINES:
            return self.of_nerfbaselines(frame, where)
        settings = ChainMap(frame, self.record)
        if lens := read_lens(settings, where):
            self.remarks.add(where, "a frame of a path is a pinhole's, without its lens", lens)
        pose = opengl_pose(frame, "transform_matrix", where, self.remarks)
        usual = replace(self.usual(settings, where), c2w=pose)
        return read_camera(settings, usual, where, self.remarks)

    def of_nerfbaselines(self, frame: dict, where: str) -> Camera:
        if (model := self.record.get("camera_model")) != "pinhole":
            raise unexpected(f"{self.file}: camera_model", "pinhole", describe(model))
        size = _numbers(self.record.get("image_size"), 2, f"{self.file}: image_size")
        width, height = (whole_number(x, f"{self.file}: image_size", 1) for x in size)
        pose = rigid_pose(frame.get("pose"), f"{where}.pose", self.remarks)
        fx, fy, cx, cy = _numbers(frame.get("intrinsics"), 4, f"{where}.intrinsics")
        fx, fy = (number(x, f"{where}.intrinsics", 0) for x in (fx, fy))
        return Camera(pose, fx, fy, cx, cy, width, height)

    def of_ngp(self, entry: dict, where: str) -> Camera:
        turn = _numbers(entry.get("R"), 4, f"{where}.R")
        number(math.hypot(*turn), f"{where}.R: its length", 0)
        centre = _numbers(entry.get("T"), 3, f"{where}.T")
        pose = np.column_stack((Rotation.from_quat(turn).as_matrix(), centre))
        usual = self.usual(entry, where)
        size = usual.width, usual.height
        return _centred(torch.from_numpy(pose), entry.get("fov"), size, where)

    def of_list(self, entry: dict, where: str) -> Camera:
        if "transform" in entry:
            pose = opengl_pose(entry, "transform", where, self.remarks)
            return replace(self.usual(entry, where), c2w=pose)
        try:
            rows = zip(entry["rotation"], entry["position"], strict=True)
            pose = rigid_pose([[*row, x] for row, x in rows], where, self.remarks)
        except (KeyError, TypeError, ValueError) as error:
            raise unexpected(where, "a position and three rows of a rotation", error) from error
        width, height = self.size(entry)
        fx, fy = (number(entry.get(k), f"{where}.{k}", 0) for k in ("fx", "fy"))
        middle = {"cx": width / 2, "cy": height / 2}
        cx, cy = (number(entry.get(k, x), f"{where}.{k}") for k, x in middle.items())
        return Camera(pose, fx, fy, cx, cy, width, height)

    def out_of_cube(self, cameras: list[Camera]) -> list[Camera]:
        """Key frames of instant-ngp, from its cube as the scene has it, or as it is by default."""
        cubes = {"0.33 x + 0.5": program_maps(self.file, {}), "of the scene": self.scene.maps}
        moved = {
            f"key frames in the cube {name}": _moved(cameras, maps["instant-ngp"], self.file)
            for name, maps in cubes.items()
            if maps
        }
        return self.nearest(moved)

    def out_of_model(self, cameras: list[Camera]) -> list[Camera]:
        """Cameras that nerfstudio wrote, moved back from a model to the data set."""
        model = self.model or self.file.with_name(MODEL)
        if not (self.model or model.is_file()):
            kind = f"without {MODEL} beside it, poses are taken as the data set's"
            how = "if they are a model's, copy its file there, or trajectory.transforms=FILE"
            self.remarks.add(self.file, kind, how)
            return cameras
        saved, forth = read_json(model.parent, model.name), torch.eye(4).double()
        forth[:3] = matrix(saved.get("transform"), f"{model}: transform")
        forth[:3] *= number(saved.get("scale"), f"{model}: scale", 0)
        number(torch.linalg.det(forth).abs().item(), f"{model}: determinant", 0)
        before = self.scene.maps.get("nerfstudio", torch.eye(4).double())
        moved = _moved(cameras, before @ torch.linalg.inv(forth), model)
        given = {} if self.model else {"those of the data set": cameras}
        return self.nearest({f"those of a model, moved back as {model} says": moved, **given})

    def nearest(self, readings: dict[str, list[Camera]]) -> list[Camera]:
        """The one that is nearest to the cameras of the data set; no file says which is right."""
        splits = self.scene.splits.values()
        there = [data_camera(self.scene, c) for split in splits for c in split.cameras]

        def far(name: str) -> float:
            between = torch.cdist(_centres(readings[name]), _centres(there))
            return between.amin(1).mean().item()

        name = min(readings, key=far) if there else next(iter(readings))
        self.remarks.add(self.file, "poses are read as", name)
        return readings[name]


def _centres(cameras: Sequence[Camera]) -> Tensor:
    return torch.stack([camera.c2w[:, 3] for camera in cameras])


def _moved(cameras: Sequence[Camera], move: Tensor, where: Path) -> list[Camera]:
    """The cameras after a similarity [4, 4] moved the world."""
    scale = number(torch.linalg.det(move).item(), f"{where}: determinant", 0) ** (1 / 3)
    moved = []
    for camera in cameras:
        turn, centre = (move[:3, :3] @ part for part in camera.c2w.split((3, 1), dim=1))
        pose = torch.cat((turn / scale, centre + move[:3, 3:]), dim=1)
        moved.append(replace(camera, c2w=pose))
    return moved


def _centred(pose: Tensor, degrees: object, size: Sequence[int], where: str) -> Camera:
    """Square pixels, the principal point at the centre, a vertical field of view."""
    width, height = size
    angle = math.radians(number(degrees, f"{where}.fov", 0, 180))
    focal = focal_length(angle, height, f"{where}.fov")
    return Camera(pose, focal, focal, width / 2, height / 2, width, height)


def _numbers(value: object, count: int, where: str) -> list[float]:
    if not isinstance(value, list) or len(value) != count:
        raise unexpected(where, f"{count} numbers", describe(value))
    return [number(x, where) for x in value]


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
        **OURS,
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

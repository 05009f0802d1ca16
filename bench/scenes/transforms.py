"""Loads a hand-held capture: the `transforms.json` of instant-ngp and nerfstudio."""

import math
import os
from collections import ChainMap
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from bench.cameras import scale_camera
from bench.errors import unexpected
from bench.scenes.assemble import (
    Box,
    assemble,
    box_of_cameras,
    describe_splits,
    space_of,
    tight,
)
from bench.scenes.files import (
    data_folder,
    describe,
    focal_length,
    frames_of,
    matrix,
    number,
    opengl_pose,
    read_json,
    whole_number,
)
from bench.scenes.images import Fisheye, Lens, RadialTangential, View, fitted_camera, image_size
from bench.scenes.lookup import find_all, report, tidy
from bench.scenes.masks import frame_mask
from bench.scenes.remarks import Remarks, says_something
from bench.scenes.splits import Listed, divide, read_lists
from bench.types import Camera, Log, Scene

CAMERA_FILE = "transforms.json"

NGP_SCALE, NGP_OFFSET = 0.33, [0.5, 0.5, 0.5]  # x becomes scale * x + offset in its unit cube

USUAL = ("k1", "k2", "p1", "p2", "k3")
LENSES: Mapping[str, tuple[type[RadialTangential | Fisheye], tuple[str, ...]]] = {
    **dict.fromkeys(
        ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "SIMPLE_RADIAL", "RADIAL"),
        (RadialTangential, USUAL),
    ),
    "FULL_OPENCV": (RadialTangential, (*USUAL, "k4", "k5", "k6")),
    "OPENCV_FISHEYE": (Fisheye, ("k1", "k2", "k3", "k4")),
}
"""The lens of a `camera_model`, and the names of its coefficients."""

OTHER_TERMS = (
    *("k3", "k4", "k5", "k6", "p1", "p2", "ftheta_p0"),
    *("latlong", "equirectangular", "rolling_shutter"),
)
"""Further terms of a lens; a file is rejected if it has one that its lens does not support."""

BOX = {"scale", "offset", "aabb_scale"}
READ = """frames file_path transform_matrix w h cx cy fl_x fl_y x_fov y_fov camera_angle_x
    camera_angle_y camera_model is_fisheye k1 k2 applied_transform train val test mask_path
    train_filenames val_filenames test_filenames"""
HARMLESS = """scene rotation sharpness colmap_im_id up orientation_override ply_file_path depth_path
    depth_file_path enable_depth_loading integer_depth_scale enable_ray_loading"""
KNOWN = {*OTHER_TERMS, *READ.split(), *HARMLESS.split()}
"""Fields that are read, or change nothing that pictures show. Others are named."""


def load(
    path: str | Path,
    *,
    split: str | None = None,
    split_every: int = 8,
    aabb_scale: float | None = None,
    downscale: int = 1,
    background: str = "white",
    space: str = "auto",
    log: Log,
) -> Scene:
    """Read the capture folder `path`; for `downscale` and `background` see `blender.load`.

    `space` is "box", the cube of instant-ngp; "all", without end around what the cameras look at;
    or "auto", the latter if the pictures have a background: no training picture is transparent.

    `split` is a file of names (see `splits.read_lists`), by default the `train_filenames`,
    `val_filenames` and `test_filenames` of the file. Without any, or with "every", pictures 0,
    split_every, 2 * split_every ..., in the order of their names, are the test split, all others
    the training split. `aabb_scale` is the side of the box relative to that of
    instant-ngp, x * 0.33 + 0.5; by default the value in the file, or 1. `scale` and `offset` in the
    file replace 0.33 and 0.5. In all of space, the file's box is not needed; of a larger one than
    instant-ngp's, the box of the visual hull of the training masks is taken.

    Intrinsics of a frame take precedence over those of the file. Lens distortion is undone, and
    pictures are cropped to what the lens saw. Frames without a picture are logged and left out.
    Masks are those of `mask_path`, or instant-ngp's `dynamic_mask_NAME.png` beside a picture.
    """
    root = data_folder(path)
    record, path = read_json(root, CAMERA_FILE), root / CAMERA_FILE
    lists = read_lists(root, split, record, path)
    splits = divide(read_views(root, record, log), split_every, lists, path, log)
    pictures = describe_splits(splits, downscale, log)
    space, cameras = space_of(space, pictures), [view.camera for view in splits["train"]]
    around = space == "all" and aabb_scale is None
    box = box_of_cameras(cameras) if around else capture_box(path, record, aabb_scale)
    if space == "box" and aabb_scale is None and record.get("aabb_scale", 1) > 1:
        box = tight(box, pictures["train"])
    scene = assemble(
        root.name, pictures, box, background=background, space=space, camera_files=[path]
    )
    return replace(scene, maps=program_maps(path, record))


def read_views(root: Path, record: dict, log: Log) -> Listed:
    path = root / CAMERA_FILE
    frames = frames_of(record, path)
    names = [frame["file_path"] for _, frame in frames]
    files = find_all(root, names)
    report(root, names, files, f"{path}: frames", log)
    remarks = Remarks()
    remarks.add_unread(path, [record, *(frame for _, frame in frames)], KNOWN | BOX)
    views: list[tuple[str, View | None]] = []
    for (where, frame), name, file in zip(frames, map(tidy, names), files, strict=True):
        if not file:
            views.append((name, None))
            continue
        settings = ChainMap(frame, record)
        views.append((name, read_view(root, file, settings, where, remarks)))
    remarks.tell(log.info)
    return views


def read_view(root: Path, file: Path, settings: ChainMap, where: str, remarks: Remarks) -> View:
    """The view of a frame. Its picture may be smaller than `w` and `h` say."""
    pose = opengl_pose(settings, "transform_matrix", where, remarks)
    width, height = image_size(file)
    usual = Camera(pose, 0, 0, width / 2, height / 2, width, height)  # without a focal length
    camera = read_camera(settings, usual, where, remarks)
    lens, mask = read_lens(settings, where), frame_mask(root, settings, file, where)
    return View(os.path.relpath(file, root), file, fitted_camera(camera, file), lens, *mask)


def read_camera(settings: ChainMap, usual: Camera, where: str, remarks: Remarks) -> Camera:
    """The pinhole camera of a frame; what is not given is that of `usual`, scaled to its size."""
    width = whole_number(settings.get("w", usual.width), f"{where}.w", 1)
    height = whole_number(settings.get("h", usual.height), f"{where}.h", 1)
    usual = scale_camera(usual, width, height)
    x, y = (focal(settings, *one, where, remarks) for one in (("x", width), ("y", height)))
    fx, fy = x or y or usual.fx, y or x or usual.fy
    if not fx:
        raise unexpected(f"{where}.fl_x", "a focal length, or camera_angle_x", "neither")
    cx = number(
        settings.get("cx", usual.cx), f"{where}.cx"
    )  # outside of a picture, if it is a crop
    cy = number(settings.get("cy", usual.cy), f"{where}.cy")
    return Camera(usual.c2w, fx, fy, cx, cy, width, height)


def focal(settings: ChainMap, axis: str, size: float, where: str, remarks: Remarks) -> float | None:
    """Focal length in pixels, from the frame or else the file; None if not given."""
    fov, length, angle = f"{axis}_fov", f"fl_{axis}", f"camera_angle_{axis}"
    for level in settings.maps:
        if not (given := [name for name in (fov, length, angle) if name in level]):
            continue
        name, *others = given
        x, at = level[name], f"{where}.{name}"
        if name == length:
            pixels = number(x, at, 0)
        else:
            pixels = focal_length(math.radians(number(x, at)) if name == fov else x, size, at)
        radians = 2 * math.atan(size / 2 / pixels)
        meant = {fov: math.degrees(radians), length: pixels, angle: radians}
        for name in others:
            x, low, high = level[name], 0.98 * meant[name], 1.02 * meant[name]
            if not (isinstance(x, int | float) and low < x < high):
                remarks.add(at, f"is taken, not {name}, which contradicts it", describe(x))
        return pixels
    return None


def read_lens(settings: Mapping, where: str) -> Lens | None:
    """The lens of a frame; None for a pinhole. instant-ngp's `is_fisheye` means OPENCV_FISHEYE.

    Raises SteerbenchError if the model is not in `LENSES`, or the file has a term that it does not
    support. k4 of the model OPENCV means different things in nerfstudio and OpenCV.
    """
    model = settings.get("camera_model", "OPENCV")
    if settings.get("is_fisheye"):
        model = "OPENCV_FISHEYE"
    if not isinstance(model, str) or model not in LENSES:
        raise unexpected(f"{where}.camera_model", f"one of {', '.join(LENSES)}", describe(model))
    kind, names = LENSES[model]
    coefficients = tuple(number(settings.get(name, 0.0), f"{where}.{name}") for name in names)
    for name in OTHER_TERMS:
        if name not in names and says_something(settings.get(name)):
            raise unexpected(f"{where}.{name}", f"a lens of {' '.join(names)}", settings[name])
    return kind(coefficients) if kind is Fisheye or any(coefficients) else None


def capture_box(path: Path, record: dict, aabb_scale: float | None) -> Box:
    """The cube `aabb_scale` times as large as instant-ngp's unit cube, in the file's units."""
    scale, offset = ngp_cube(path, record)
    given = aabb_scale is not None
    sides = aabb_scale if given else record.get("aabb_scale", 1)
    half = number(sides, "aabb_scale" if given else f"{path}: aabb_scale", 0) / scale / 2
    middle = (0.5 - offset) / scale
    return Box(middle - half, middle + half)


def ngp_cube(path: Path, record: dict) -> tuple[float, Tensor]:
    """instant-ngp's `scale` and `offset` [3] float64, or its defaults."""
    scale = number(record.get("scale", NGP_SCALE), f"{path}: scale", 0)
    offset = record.get("offset", NGP_OFFSET)
    if isinstance(offset, int | float):
        offset = [offset] * 3
    if not isinstance(offset, list) or len(offset) != 3:
        raise unexpected(f"{path}: offset", "three numbers", describe(offset))
    offset = [number(x, f"{path}: offset[{i}]") for i, x in enumerate(offset)]
    return scale, torch.tensor(offset, dtype=torch.float64)


def program_maps(path: Path, record: dict) -> dict[str, Tensor]:
    """`Scene.maps` of a capture: from instant-ngp's cube, whose axes are in turn, and from where
    poses were before what nerfstudio says that it applied to them."""
    scale, offset = ngp_cube(path, record)
    cube, applied = torch.eye(4).double()[[2, 0, 1, 3]], torch.eye(4).double()
    cube[:3] /= scale
    cube[:3, 3] = -offset / scale
    if "applied_transform" in record:
        applied[:3] = matrix(record["applied_transform"], f"{path}: applied_transform")
    return {"instant-ngp": cube, "nerfstudio": applied}

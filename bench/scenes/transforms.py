"""Loads a hand-held capture: the `transforms.json` of instant-ngp and nerfstudio."""

import math
import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from bench.cameras import scale_camera
from bench.errors import unexpected
from bench.records import read_json
from bench.scenes.assemble import Box, assemble, box_of_cameras, describe_splits, space_of, tight
from bench.scenes.files import (
    Fields,
    data_folder,
    describe,
    focal_length,
    frames_of,
    matrix,
    number,
    numbers_of,
    opengl_to_opencv,
)
from bench.scenes.images import Fisheye, Lens, RadialTangential, View, fitted_camera, image_size
from bench.scenes.lookup import find_all, report, tidy
from bench.scenes.masks import frame_mask
from bench.scenes.remarks import Remarks, says_something
from bench.scenes.splits import Listed, divide, read_lists
from bench.types import Camera, Log, Scene

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

READ = """frames file_path transform_matrix w h cx cy fl_x fl_y x_fov y_fov camera_angle_x
    camera_angle_y camera_model is_fisheye k1 k2 applied_transform mask_path scale offset aabb_scale
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
    or "auto": see `assemble.space_of`. `split` is a file of names (see `splits.read_lists`), by
    default the lists `test_filenames` and so on of the file. Without any, pictures 0, split_every,
    2 * split_every ... by name are the test split, the others train.

    `aabb_scale` is the side of the box relative to that of instant-ngp, x * 0.33 + 0.5, whose
    numbers `scale` and `offset` replace; by default the value in the file, or 1. Where that is
    larger, the box is that of the visual hull of the training masks; so it is, within the box of
    the cameras, where the file has none of the three. In all of space, it is not needed.

    Intrinsics of a frame take precedence over those of the file. Lens distortion is undone, and
    pictures are cropped to what the lens saw. Frames without a picture are logged and left out.
    Masks are those of `mask_path`, or instant-ngp's `dynamic_mask_NAME.png` beside a picture.
    """
    root = data_folder(path)
    record = read_json(path := root / "transforms.json")
    lists = read_lists(root, split, record, path)
    splits = divide(read_views(root, record, path, log), split_every, lists, path, log)
    pictures = describe_splits(splits, downscale, log)
    space = space_of(space, pictures, background)
    cube = record.keys() & {"aabb_scale", "scale", "offset"}  # which only instant-ngp has
    if aabb_scale is None and (space == "all" or not cube):
        box = box_of_cameras([view.camera for view in splits["train"]])
    else:
        box = capture_box(path, record, aabb_scale)
    if space == "box" and aabb_scale is None and (record.get("aabb_scale", 1) > 1 or not cube):
        box = tight(box, pictures["train"])
    files = {path, lists[0]} if lists else {path}
    scene = assemble(
        root.name, pictures, box, background=background, space=space, camera_files=sorted(files)
    )
    return replace(scene, maps=program_maps(path, record))


def read_views(
    root: Path, record: dict, path: Path, log: Log, every: bool = False, optional: bool = False
) -> Listed:
    """The pictures of the frames in a `record`, the file `path`, of any size in their proportions.
    Raises if not `every` one is there, or none, unless they are `optional`."""
    frames = frames_of(record, path)
    names = [frame["file_path"] for frame in frames]
    files = find_all(root, names)
    if optional and not any(files):
        log.info(f"{path.name}: none of its {len(files)} pictures are there, split left out")
        return []
    report(root, names, files, f"{path}: frames", log, every)
    remarks = Remarks()
    views = list[tuple[str, View | None]]()
    remarks.add_unread(path, [record, *frames], KNOWN)
    for frame, name, file in zip(frames, map(tidy, names), files, strict=True):
        if not file:
            views.append((name, None))
            continue
        pose = opengl_to_opencv(frame.pose("transform_matrix", remarks))
        width, height = image_size(file)
        usual = Camera(pose, 0, 0, width / 2, height / 2, width, height)  # without a focal length
        camera = fitted_camera(read_camera(frame, usual, remarks), file)
        lens = read_lens(frame)
        mask = frame_mask(root, frame, file)
        views.append((name, View(os.path.relpath(file, root), file, camera, lens, *mask)))
    remarks.tell(log.info)
    return views


def read_camera(settings: Fields, usual: Camera, remarks: Remarks) -> Camera:
    """The pinhole camera of a frame; what is not given is that of `usual`, scaled to its size."""
    width = settings.size("w", usual.width)
    height = settings.size("h", usual.height)
    usual = scale_camera(usual, width, height)
    x = focal(settings, "x", width, remarks)
    y = focal(settings, "y", height, remarks)
    fx = x or y or usual.fx
    fy = y or x or usual.fy
    if not fx:
        expected = "a focal length, or camera_angle_x"
        raise unexpected(settings.place("fl_x"), expected, "neither")
    # Outside of a picture, if it is a crop.
    cx = settings.number("cx", usual=usual.cx)
    cy = settings.number("cy", usual=usual.cy)
    return Camera(usual.c2w, fx, fy, cx, cy, width, height)


def focal(settings: Fields, axis: str, size: float, remarks: Remarks) -> float | None:
    """Focal length in pixels, from the frame or else the file; None if not given."""
    fov = f"{axis}_fov"
    length = f"fl_{axis}"
    angle = f"camera_angle_{axis}"
    for level in settings.maps:
        given = {name: level[name] for name in (fov, length, angle) if name in level}
        if not given:
            continue
        name, x = next(iter(given.items()))
        at = settings.place(name)
        if name == length:
            pixels = number(x, at, 0)
        else:
            pixels = focal_length(math.radians(number(x, at)) if name == fov else x, size, at)
        radians = 2 * math.atan(size / 2 / pixels)
        meant = {fov: math.degrees(radians), length: pixels, angle: radians}
        for other, y in given.items():
            low = 0.98 * meant[other]
            high = 1.02 * meant[other]
            if not (isinstance(y, int | float) and low < y < high):
                remarks.add(at, f"is taken, not {other}, which contradicts it", describe(y))
        return pixels
    return None


def read_lens(settings: Fields) -> Lens | None:
    """The lens of a frame; None for a pinhole. instant-ngp's `is_fisheye` means OPENCV_FISHEYE.

    Raises SteerbenchError if the model is not in `LENSES`, or the file has a term that it does not
    support. k4 of the model OPENCV means different things in nerfstudio and OpenCV.
    """
    model = settings.get("camera_model", "OPENCV")
    if settings.get("is_fisheye"):
        model = "OPENCV_FISHEYE"
    if not isinstance(model, str) or model not in LENSES:
        raise settings.wrong("camera_model", f"one of {', '.join(LENSES)}")
    kind, names = LENSES[model]
    coefficients = tuple(settings.number(name, usual=0.0) for name in names)
    for name in OTHER_TERMS:
        if name not in names and says_something(settings.get(name)):
            given = settings[name]
            raise unexpected(settings.place(name), f"a lens of {' '.join(names)}", given)
    return kind(coefficients) if kind is Fisheye or any(coefficients) else None


def capture_box(path: Path, record: dict, aabb_scale: float | None) -> Box:
    """The cube `aabb_scale` times as large as instant-ngp's unit cube, in the file's units."""
    scale, offset = ngp_cube(path, record)
    where = f"{path}: aabb_scale" if aabb_scale is None else "aabb_scale"
    sides = record.get("aabb_scale", 1) if aabb_scale is None else aabb_scale
    half, middle = number(sides, where, 0) / scale / 2, (0.5 - offset) / scale
    return Box(middle - half, middle + half)


def ngp_cube(path: Path, record: dict) -> tuple[float, Tensor]:
    """instant-ngp's `scale` and `offset` [3] float64, or its defaults."""
    offset = record.get("offset", NGP_OFFSET)
    offset = [offset] * 3 if isinstance(offset, int | float) else offset
    offset = numbers_of(offset, 3, f"{path}: offset")
    scale = number(record.get("scale", NGP_SCALE), f"{path}: scale", 0)
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

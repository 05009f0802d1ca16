"""Loads a capture reconstructed by COLMAP: a sparse model beside the pictures."""

import struct
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from bench.cameras import scale_camera
from bench.errors import Unavailable, install_command, unexpected
from bench.scenes.assemble import (
    Box,
    assemble,
    box_of_cameras,
    describe_splits,
    every_nth,
    leave_out,
    parse_box,
    space_of,
)
from bench.scenes.files import data_folder, inside, rigid_pose
from bench.scenes.images import Lens, View, image_size
from bench.scenes.masks import with_masks
from bench.types import Camera, Log, Scene

MODELS = ("sparse/0", "colmap/sparse/0", "sparse", ".")  # where a model may be, in this order

LISTS = {"frames": (64, "<I", 16), "images": (64, "<Q", 24), "points3D": (43, "<Q", 8)}
"""Layout of an entry in each binary list: bytes before the count of its parts (for an image, plus a
name), the type of this count, bytes per part."""

STRAY = 0.01  # share of the points, at either end of an axis, that the box may exclude
ASPECT = 0.01  # largest relative difference of the aspect ratios of a picture and its camera


def load(
    path: str | Path,
    *,
    images: str = "images",
    model: str | None = None,
    masks: str | None = "auto",
    split_every: int = 8,
    bounds: str | list = "auto",
    downscale: int = 1,
    background: str = "white",
    space: str = "auto",
    log: Log,
) -> Scene:
    """Read the capture folder `path`: its pictures in `images`, its sparse model in `model`.

    The pictures may be smaller than those that COLMAP saw; the model is by default the first of
    `MODELS`. `bounds` are those of the box: "auto" or [[x, y, z], [x, y, z]]. "auto" is the box of
    the points without outliers, or, in all of space, that of the cameras. For `masks` see
    `masks.with_masks`, for `split_every` and `space` `transforms.load`, for `downscale` and
    `background` `blender.load`.

    Lens distortion is undone for every COLMAP camera model that has a focal length, and pictures
    are cropped to what the lens saw. Pictures that COLMAP did not register are ignored. Registered
    pictures that are missing are logged and left out. Raises Unavailable without pycolmap.
    """
    root = data_folder(path)
    folder = model_folder(root, model)
    reconstruction = read_model(folder)
    views = read_views(root, images, folder, reconstruction, log)
    splits = every_nth(with_masks(views, root, images, masks, log), split_every, folder)
    pictures = describe_splits(splits, downscale, log)
    space = space_of(space, pictures)
    if bounds != "auto":
        box = parse_box(bounds)
    elif space == "all":
        box = box_of_cameras([view.camera for view in splits["train"]])
    elif not reconstruction.num_points3D():
        raise unexpected(folder, "points, or scene.bounds=[[x,y,z],[x,y,z]]", "no point")
    else:
        points = reconstruction.compute_bounding_box(STRAY, 1 - STRAY)
        box = Box(torch.tensor(points.min), torch.tensor(points.max)).grown()
    files = sorted(folder.glob(f"*{_kind(folder)}"))
    where = {"background": background, "space": space, "camera_files": files}
    return assemble(root.name, pictures, box, **where)


def model_folder(root: Path, model: str | None) -> Path:
    places = MODELS if model is None else (model,)
    for place in places:
        folder = inside(root, place, "scene.model")
        if _kind(folder):
            return folder
    raise unexpected(root, f"cameras.bin or cameras.txt in {' or '.join(places)}", "neither")


def _kind(folder: Path) -> str:
    """The file ending of a model: binary before text, as in COLMAP; empty if there is no model."""
    return next((end for end in (".bin", ".txt") if (folder / f"cameras{end}").is_file()), "")


def read_model(folder: Path) -> Any:
    try:
        import pycolmap
    except ImportError as error:
        how = install_command("colmap")
        raise Unavailable(f"{folder}: models of COLMAP need pycolmap: {how}") from error
    for name in LISTS:
        check_length(folder / f"{name}.bin")
    try:
        return pycolmap.Reconstruction(folder)
    except (ValueError, RuntimeError, LookupError, MemoryError) as error:
        raise unexpected(folder, "a whole model of COLMAP", " ".join(str(error).split())) from error


def check_length(file: Path) -> None:
    """Raise if a binary list is shorter than its counts say: pycolmap would read on for minutes."""
    if not file.is_file():
        return
    content = file.read_bytes()
    head, count, size = LISTS[file.stem]
    try:
        (entries,) = struct.unpack_from("<Q", content)
        end = 8
        for _ in range(entries):
            end += head
            if file.stem == "images":
                end = content.index(0, end) + 1  # the end of its name
            (parts,) = struct.unpack_from(count, content, end)
            end += struct.calcsize(count) + parts * size
        whole = end <= len(content)
    except (struct.error, ValueError, OverflowError):
        whole = False
    if not whole:
        raise unexpected(file.parent, "a whole model of COLMAP", f"{file.name} cut short")


def read_views(root: Path, images: str, folder: Path, reconstruction: Any, log: Log) -> list[View]:
    pictures = inside(root, images, "scene.images")
    views, missing = [], []
    for image in reconstruction.images.values():
        if not image.has_pose:
            continue
        where = f"{folder}: {image.name}"
        file = inside(pictures, image.name, where)
        if not file.is_file():
            missing.append(image.name)
            continue
        camera, lens = read_camera(image, file, where)
        views.append(View(image.name, file, camera, lens))
    leave_out(missing, views, str(folder), log)
    return views


def read_camera(image: Any, file: Path, where: str) -> tuple[Camera, Lens | None]:
    """The pinhole camera of an image, at the size of its picture, and its lens."""
    of_image = image.camera
    if not of_image.focal_length_idxs():
        raise unexpected(where, "a camera model with a focal length", of_image.model_name)
    pose = rigid_pose(image.cam_from_world().inverse().matrix().tolist(), where)
    (fx, _, cx), (_, fy, cy), _ = of_image.calibration_matrix().tolist()
    camera = Camera(pose, fx, fy, cx, cy, of_image.width, of_image.height)
    width, height = image_size(file)
    if abs((width / camera.width) / (height / camera.height) - 1) > ASPECT:
        expected = f"{camera.width} x {camera.height} pixels, or as wide for its height"
        raise unexpected(file, f"a picture of {expected}", f"{width} x {height}")
    pinhole = of_image.is_perspective_pinhole() and of_image.is_undistorted()
    lens = None if pinhole else ColmapLens(of_image.model_name, tuple(of_image.params))
    return scale_camera(camera, width, height), lens


@dataclass(frozen=True)
class ColmapLens:
    model: str
    params: tuple[float, ...]

    @cached_property
    def _camera(self) -> Any:
        import pycolmap

        return pycolmap.Camera(model=self.model, width=1, height=1, params=self.params)

    def __call__(self, points: Tensor) -> Tensor:
        camera = self._camera
        seen = camera.img_from_cam(np.column_stack((points.numpy(), np.ones(len(points)))))
        matrix = torch.from_numpy(camera.calibration_matrix())
        return (torch.from_numpy(seen) - matrix[:2, 2]) / matrix.diagonal()[:2]

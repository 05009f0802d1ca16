"""Loads a capture reconstructed by COLMAP: a sparse model beside the pictures."""

import math
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from bench.errors import optional, unexpected
from bench.scenes.assemble import (
    Box,
    assemble,
    box_of_cameras,
    describe_splits,
    parse_box,
    space_of,
)
from bench.scenes.files import data_folder, number, rigid_pose
from bench.scenes.images import Lens, View, fitted_camera
from bench.scenes.lookup import absent, bare, find_all, found, in_any_case, natural, report, tidy
from bench.scenes.masks import mask_folder, mask_in
from bench.scenes.remarks import Remarks
from bench.scenes.sparse import Entry, read_cameras, read_images, read_points
from bench.scenes.splits import Listed, divide, read_lists
from bench.types import Camera, Log, Scene

MODELS = ("sparse/0", "colmap/sparse/0", "sparse", ".")  # where a model may be, in this order

STRAY = 0.01  # share of the points, at either end of an axis, that the box may exclude


def load(
    path: str | Path,
    *,
    images: str = "images",
    model: str | None = None,
    masks: str | None = "auto",
    split: str | None = None,
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
    `masks.mask_folder`, for `split`, `split_every` and `space` `transforms.load`, for `downscale`
    and `background` `blender.load`.

    Lens distortion is undone for every COLMAP camera model that has a focal length, and pictures
    are cropped to what the lens saw. Pictures that COLMAP did not register are ignored. Registered
    pictures that are missing are logged and left out. Raises Unavailable without pycolmap.
    """
    root = data_folder(path)
    folder = model_folder(root, model)
    optional("pycolmap", "colmap", f"{folder}: a model of COLMAP")
    lists = read_lists(root, split, {}, folder)
    listed = read_views(root, images, folder, mask_folder(root, images, masks), log)
    splits = divide(listed, split_every, lists, folder, log)
    pictures = describe_splits(splits, downscale, log)
    space = space_of(space, pictures, background)
    if bounds != "auto":
        box = parse_box(bounds)
    elif space == "all":
        box = box_of_cameras([view.camera for view in splits["train"]])
    else:
        box = points_box(folder)
    files = sorted(folder.glob(f"*{_kind(folder)}"))
    if lists:
        files.append(lists[0])
    return assemble(
        root.name, pictures, box, background=background, space=space, camera_files=files
    )


def model_folder(root: Path, model: str | None) -> Path:
    places = MODELS if model is None else (model,)
    for place in places:
        folder = in_any_case(root / tidy(place), os.path.isdir)
        if folder and _kind(folder):
            return folder
    expected = f"cameras.bin or cameras.txt in {' or '.join(places)}"
    raise unexpected(root, expected, absent(root, f"{places[0]}/cameras.bin"))


def _kind(folder: Path) -> str:
    """The file ending of a model: binary before text, as in COLMAP; empty if there is no model."""
    return next((end for end in (".bin", ".txt") if (folder / f"cameras{end}").is_file()), "")


def points_box(folder: Path) -> Box:
    """The box of a model's points without outliers; of the first list that has any."""
    files = (in_any_case(folder / f"points3D{ending}") for ending in (".bin", ".txt", ".ply"))
    points = next(filter(len, map(read_points, filter(None, files))), np.empty((0, 3)))
    points = np.sort(points[np.isfinite(points).all(axis=1)], axis=0)
    if not len(points):
        expected = "points3D.bin, .txt or .ply with points, or scene.bounds=[[x,y,z],[x,y,z]]"
        raise unexpected(folder, expected, "no point")
    last, stray = len(points) - 1, int(STRAY * (len(points) - 1))
    return Box(*torch.from_numpy(points[[stray, last - stray]])).grown()


def read_views(root: Path, images: str, folder: Path, masks: Path | None, log: Log) -> Listed:
    place = found(root, images, "scene.images", "a folder of pictures", os.path.isdir)
    cameras = read_cameras(folder / f"cameras{_kind(folder)}")
    entries = read_images(folder / f"images{_kind(folder)}")
    names = [words[-1] for _, words in entries]
    files = find_all(place, names)
    if not any(files) and (ordered := in_order(root / "images", names, place)):
        files, first = ordered, f"{ordered[0]} for {names[0]}"
        log.info(f"{place}: pictures are paired in the order of names: {first}")
    else:
        report(place, names, files, str(folder), log, False)
    if rest := sorted({*pictures_below(place)} - {*files}):
        log.info(f"{folder}: left out as not in it: {len(rest)} pictures, {rest[0]} is the first")
    views: list[tuple[str, View | None]] = []
    for entry, name, file in zip(entries, map(tidy, names), files, strict=True):
        mask = masks and mask_in(masks, name)
        view = None
        if file:
            view = View(name, file, *read_camera(entry, cameras, file), mask, stored=True)
        views.append((name, view))
    if masks and not any(view and view.mask for _, view in views):
        log.info(f"{masks}: not used: no picture has its mask there, {views[0][0]}.png or so")
    return views


def pictures_below(folder: Path) -> list[Path]:
    return [file for file in folder.rglob("*") if bare(file.name) != file.name]


def in_order(full: Path, names: Sequence[str], folder: Path) -> list[Path | None]:
    """The pictures in `folder` in the order of `names`, as LLFF's images_8 are paired with images.

    Where the folder `full` has all `names`, its other pictures count, too: those that COLMAP did
    not register. Nothing if there are more or fewer, or letters and numbers sort names differently.
    """
    there, every = (
        sorted(str(file.relative_to(of)) for file in pictures_below(of)) for of in (folder, full)
    )
    every = every if {*names} <= {*every} else sorted(names)
    sure = all(sorted(of, key=lambda name: natural(bare(name))) == of for of in (there, every))
    if len(there) != len(every) or not sure:
        return []
    return [folder / there[every.index(name)] for name in names]


def read_camera(
    entry: Entry, cameras: Mapping[str, Entry], file: Path
) -> tuple[Camera, Lens | None]:
    """The pinhole camera of an image, at the size of its picture, and its lens."""
    import pycolmap

    where, (*pose, camera_id, name) = entry
    where = f"{where}: {name}"
    of_image = camera_of(cameras, str(camera_id), where)
    if not of_image.focal_length_idxs():
        raise unexpected(where, "a camera model with a focal length", of_image.model_name)
    qw, qx, qy, qz, *shift = (number(float(word), where) for word in pose)
    number(math.hypot(qw, qx, qy, qz), f"{where}: length of its quaternion", 0)
    from_world = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array((qx, qy, qz, qw))), np.array(shift))
    c2w = rigid_pose(from_world.inverse().matrix().tolist(), where, Remarks())
    (fx, _, cx), (_, fy, cy), _ = of_image.calibration_matrix().tolist()
    camera = Camera(c2w, fx, fy, cx, cy, of_image.width, of_image.height)
    pinhole = of_image.is_perspective_pinhole() and of_image.is_undistorted()
    lens = None if pinhole else ColmapLens(of_image.model_name, tuple(of_image.params))
    return fitted_camera(camera, file), lens


def camera_of(cameras: Mapping[str, Entry], camera_id: str, image: str) -> Any:
    """The camera of an `image`, as pycolmap has it; raises if it is missing or damaged."""
    import pycolmap

    where, words = cameras.get(camera_id, (image, ("CAMERA_ID", camera_id, "without an entry")))
    with suppress(ValueError, LookupError, RuntimeError, TypeError):
        _, model, width, height, *params = words
        kind, size = pycolmap.CameraModelId.__members__[model], (int(width), int(height))
        params = [number(float(word), where) for word in params]
        camera = pycolmap.Camera(model=kind, width=size[0], height=size[1], params=params)
        if camera.verify_params() and min(size) > 0:
            return camera
    expected = "CAMERA_ID MODEL WIDTH HEIGHT PARAMS[] as COLMAP has them"
    raise unexpected(where, expected, " ".join(map(str, words)))


@dataclass(frozen=True)
class ColmapLens:
    model: str
    params: tuple[float, ...]

    def __call__(self, points: Tensor) -> Tensor:
        import pycolmap

        camera = pycolmap.Camera(model=self.model, width=1, height=1, params=self.params)
        seen = camera.img_from_cam(np.column_stack((points.numpy(), np.ones(len(points)))))
        matrix = torch.from_numpy(camera.calibration_matrix())
        return (torch.from_numpy(seen) - matrix[:2, 2]) / matrix.diagonal()[:2]

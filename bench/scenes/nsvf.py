"""Loads NSVF's layout, also of Tanks & Temples: `bbox.txt intrinsics.txt pose/*.txt rgb/*`."""

import os
import re
from dataclasses import replace
from pathlib import Path

import torch

from bench.errors import unexpected
from bench.records import read_text
from bench.scenes.assemble import MARGIN, Box, assemble, describe_splits
from bench.scenes.files import data_folder, number, numbers, rigid_pose, whole_number
from bench.scenes.images import View, fitted_camera, image_size
from bench.scenes.lookup import found, in_any_case
from bench.scenes.remarks import Remarks
from bench.types import Camera, Log, Scene

SPLITS = {"0": "train", "1": "val", "2": "test"}  # by the first character of a picture's name

FURTHER = {"Mic": 1.2, "Lego": 1.1}
"""Extra factors for the boxes of two scenes, by the name of the folder: those of ngp_pl and of the
release of SteerNeRF, which has them from there."""

PICTURE_NAME = re.compile(r"[012]_.*\.(png|jpg|jpeg)", re.IGNORECASE)


def load(path: str | Path, *, downscale: int = 1, background: str = "white", log: Log) -> Scene:
    """Read the scene folder `path`; for `downscale` and `background` see `blender.load`.

    Pictures and poses are named 0_* (train), 1_* (val) and 2_* (test); poses have OpenCV axes.
    If there are no 2_*, the 1_* are the test split, as in Tanks & Temples. The box of `bbox.txt`,
    with a margin of 5 % of its longest side, fills the unit cube.
    """
    root = data_folder(path)
    box = read_box(root)
    files = picture_files(root)
    remarks, of_all = Remarks(), read_intrinsics(root, files[0])
    views: dict[str, list[View]] = {}
    camera_files = [root / "bbox.txt", root / "intrinsics.txt"]
    for file in files:
        where = root / "pose" / f"{file.stem}.txt"
        where = in_any_case(where) or where
        camera_files.append(where)
        rows, _ = read_matrix(where)
        camera = replace(of_all, c2w=rigid_pose(rows, str(where), remarks))
        view = View(f"rgb/{file.name}", file, camera)
        views.setdefault(SPLITS[file.name[0]], []).append(view)
    poses = {path.stem for path in (root / "pose").glob("*.txt")}
    if rest := sorted(poses - {file.stem for file in files}):
        log.info(f"{root}: poses without a picture: {len(rest)}, {rest[0]} is the first")
    if "test" not in views and "val" in views:
        log.info(f"{root / 'rgb'}: no pictures 2_*, so 1_* are the test split")
        views["test"] = views.pop("val")
    for split, names in (("train", "0_*"), ("test", "2_* or 1_*")):
        if split not in views:
            raise unexpected(root / "rgb", f"pictures {names}", "none")
    remarks.tell(log.info)
    pictures = describe_splits(views, downscale, log)
    return assemble(root.name, pictures, box, background=background, camera_files=camera_files)


def read_box(root: Path) -> Box:
    """The box of `bbox.txt` (x0 y0 z0 x1 y1 z1 and an unused voxel size), with a margin and,
    for two scenes, the further factor of `FURTHER`."""
    path = root / "bbox.txt"
    values = [x for row in numbers(read_text(path), path) for x in row]
    if len(values) not in (6, 7):
        raise unexpected(path, "x0 y0 z0 x1 y1 z1 and a voxel size", f"{len(values)} numbers")
    corners = [number(x, f"{path}: number {i + 1}") for i, x in enumerate(values[:6])]
    lower, upper = torch.tensor(corners, dtype=torch.float64).reshape(2, 3)
    if (upper <= lower).any():
        raise unexpected(path, "each upper bound above its lower", corners)
    return Box(lower, upper).grown((1 + MARGIN) * FURTHER.get(root.name, 1) - 1)


def read_intrinsics(root: Path, picture: Path) -> Camera:
    """The camera of `intrinsics.txt`, without a pose, at the size of a picture.

    In the file: a matrix of 3x3, 3x4 or 4x4; or a line "f cx cy 0", "f cx cy" or "fx fy cx cy",
    above data that are not used. If it has a height and width, that is the size that it holds for.
    """
    path = root / "intrinsics.txt"
    rows, size = read_matrix(path)
    first, *others = rows or [[]]
    if [len(row) for row in rows] in ([3] * 3, [4] * 3, [4] * 4):
        (fx, skew, cx, *_), (low, fy, cy, *_), last, *_ = rows
        if [skew, low, *last[:3]] != [0, 0, 0, 0, 1]:
            raise unexpected(path, "rows fx 0 cx, 0 fy cy and 0 0 1", rows)
    elif len(first) in (3, 4) and all(len(row) <= 3 for row in others):
        fx, fy, cx, cy = first if any(first[3:]) else (first[0], *first[:3])
    else:
        forms = 'a 4x4, 3x4 or 3x3 matrix, or a first line "f cx cy 0" or "fx fy cx cy"'
        raise unexpected(path, forms, f"lines of {[len(row) for row in rows]} numbers")
    fx, fy = number(fx, f"{path}: fx", 0), number(fy, f"{path}: fy", 0)
    cx, cy = number(cx, f"{path}: cx"), number(cy, f"{path}: cy")
    height, width = (whole_number(x, f"{path}: size", 1) for x in size or image_size(picture)[::-1])
    return fitted_camera(Camera(torch.empty(0), fx, fy, cx, cy, width, height), picture)


def read_matrix(path: Path) -> tuple[list[list[float]], list[float]]:
    """The rows of numbers in a file, a matrix in one line as 3 or 4 of them; and, which NSVF skips,
    a line of two numbers."""
    rows = numbers(read_text(path), path)
    sizes = [row for row in rows if len(row) == 2]
    rows = [row for row in rows if len(row) != 2]
    if len(rows) == 1 and (count := {9: 3, 12: 4, 16: 4}.get(len(rows[0]))):
        rows = [rows[0][start : start + count] for start in range(0, len(rows[0]), count)]
    return rows, sizes[-1] if sizes else []


def picture_files(root: Path) -> list[Path]:
    folder = found(root, "rgb", root / "rgb", "a folder of pictures", os.path.isdir)
    names = sorted(path.name for path in folder.iterdir() if PICTURE_NAME.fullmatch(path.name))
    if not names:
        raise unexpected(folder, "pictures named 0_*, 1_* or 2_*", "none")
    return [folder / name for name in names]

"""Loads NSVF's layout, also of Tanks & Temples: `bbox.txt intrinsics.txt pose/*.txt rgb/*`."""

import os
import re
from pathlib import Path

import torch

from bench.errors import unexpected
from bench.scenes.assemble import MARGIN, Box, assemble, describe_splits
from bench.scenes.files import data_folder, number, numbers, read_text, rigid_pose
from bench.scenes.images import View, image_size
from bench.scenes.lookup import absent, in_any_case
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
    inner = (*read_intrinsics(root), *image_size(files[0]))
    views: dict[str, list[View]] = {}
    camera_files = [root / "bbox.txt", root / "intrinsics.txt"]
    for file in files:
        where = root / "pose" / f"{file.stem}.txt"
        where = in_any_case(where) or where
        camera_files.append(where)
        rows = numbers(read_text(where.parent, where.name), where)
        camera = Camera(rigid_pose(rows, str(where)), *inner)
        view = View(f"rgb/{file.name}", file, camera)
        views.setdefault(SPLITS[file.name[0]], []).append(view)
    if "test" not in views and "val" in views:
        log.info(f"{root / 'rgb'}: no pictures 2_*, so 1_* are the test split")
        views["test"] = views.pop("val")
    for split, names in (("train", "0_*"), ("test", "2_* or 1_*")):
        if split not in views:
            raise unexpected(root / "rgb", f"pictures {names}", "none")
    pictures = describe_splits(views, downscale, log)
    return assemble(root.name, pictures, box, background=background, camera_files=camera_files)


def read_box(root: Path) -> Box:
    """The box of `bbox.txt` (x0 y0 z0 x1 y1 z1 and an unused voxel size), with a margin and,
    for two scenes, the further factor of `FURTHER`."""
    path = root / "bbox.txt"
    values = [x for row in numbers(read_text(root, path.name), path) for x in row]
    if len(values) not in (6, 7):
        raise unexpected(path, "x0 y0 z0 x1 y1 z1 and a voxel size", f"{len(values)} numbers")
    corners = [number(x, f"{path}: number {i + 1}") for i, x in enumerate(values[:6])]
    lower, upper = torch.tensor(corners, dtype=torch.float64).reshape(2, 3)
    if (upper <= lower).any():
        raise unexpected(path, "each upper bound above its lower", corners)
    return Box(lower, upper).grown((1 + MARGIN) * FURTHER.get(root.name, 1) - 1)


def read_intrinsics(root: Path) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy from a 4x4 or 3x3 matrix, or a first line "f cx cy 0" above other data."""
    path = root / "intrinsics.txt"
    rows = numbers(read_text(root, path.name), path)
    if [len(row) for row in rows] in ([4] * 4, [3] * 3):
        (fx, _, cx, *_), (_, fy, cy, *_) = rows[:2]
    elif rows and len(rows[0]) == 4:
        fx, cx, cy, _ = rows[0]
        fy = fx
    else:
        got = f"lines of {[len(row) for row in rows]} numbers"
        raise unexpected(path, 'a 4x4 or 3x3 matrix or a first line "f cx cy 0"', got)
    fx, fy = number(fx, f"{path}: fx", 0), number(fy, f"{path}: fy", 0)
    return fx, fy, number(cx, f"{path}: cx"), number(cy, f"{path}: cy")


def picture_files(root: Path) -> list[Path]:
    folder = in_any_case(root / "rgb", os.path.isdir)
    if not folder:
        raise unexpected(root / "rgb", "a folder of pictures", absent(root, "rgb"))
    names = sorted(path.name for path in folder.iterdir() if PICTURE_NAME.fullmatch(path.name))
    if not names:
        raise unexpected(folder, "pictures named 0_*, 1_* or 2_*", "none")
    return [folder / name for name in names]

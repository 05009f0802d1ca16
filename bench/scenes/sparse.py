"""Reads a sparse model of COLMAP, binary or text; of it only cameras, poses and positions.

An entry is the words of its line in a text, or what a binary list has in their places.
"""

import re
import struct
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from plyfile import PlyData, PlyParseError

from bench.errors import unexpected
from bench.records import read_text
from bench.scenes.lookup import found

Entry = tuple[str, Sequence[Any]]  # where an entry is, for messages, and its words
Found = tuple[list[Any], int]  # the words of an entry of a binary list, and where the next begins

REAL = r"\s+([-+]?(?:(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?|nan|inf))"
IMAGE = re.compile(r"\d+" + 7 * REAL + r"\s+(\d+)\s+(.+)", re.IGNORECASE)
KEYPOINT = rf"(?:{REAL}{REAL}\s+-?\d+)"  # X Y POINT3D_ID
KEYPOINTS = re.compile(rf"{KEYPOINT}{{1,4}}$|{KEYPOINT}{{4}}\s", re.IGNORECASE)


def read_cameras(file: Path) -> dict[str, Entry]:
    """The entries CAMERA_ID MODEL WIDTH HEIGHT PARAMS[], unchecked, by their id."""
    text = ((where, line.split()) for where, line in _lines(file) if line)
    entries = _entries(file, _camera) if file.suffix == ".bin" else text
    return {str(words[0]): (where, words) for where, words in entries}


def read_images(file: Path) -> list[Entry]:
    """The entries QW QX QY QZ TX TY TZ CAMERA_ID NAME; at least one."""
    images = list(_entries(file, _image) if file.suffix == ".bin" else _text_images(file))
    if not images:
        raise unexpected(file, "images", "none")
    return images


def read_points(file: Path) -> np.ndarray:
    """The positions [N, 3] of the points, float64; also of a PLY file."""
    if file.suffix == ".ply":
        try:
            vertices = PlyData.read(file, mmap=False)["vertex"]
            return np.stack([vertices[axis] for axis in "xyz"], axis=1).astype(np.float64)
        except (PlyParseError, KeyError, ValueError) as error:
            raise unexpected(file, "points with x, y and z", error) from error
    entries = _entries(file, _point) if file.suffix == ".bin" else _text_points(file)
    return np.array([words for _, words in entries], dtype=np.float64).reshape(-1, 3)


def _lines(file: Path) -> Iterator[tuple[str, str]]:
    """The lines of a text but comments, and where they are."""
    for number, line in enumerate(map(str.strip, read_text(file).split("\n")), start=1):
        if not line.startswith("#"):
            yield f"{file}: line {number}", line


def _text_images(file: Path) -> Iterator[Entry]:
    """Two lines an image; the second, its keypoints, may be empty or missing."""
    above = False  # whether the line above is an image
    for where, line in _lines(file):
        above = bool(line) and not (above and KEYPOINTS.match(f" {line}"))
        if above:
            if not (match := IMAGE.fullmatch(line)):
                expected = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, keypoints a line below"
                raise unexpected(where, expected, repr(line[:80]))
            yield where, match.groups()


def _text_points(file: Path) -> Iterator[Entry]:
    for where, line in _lines(file):
        try:
            if line:
                x, y, z = map(float, line.split(maxsplit=4)[1:4])
                yield where, (x, y, z)
        except ValueError as error:
            raise unexpected(where, "POINT3D_ID X Y Z ...", repr(line[:80])) from error


def _entries(file: Path, read: Callable[[bytes, int], Found]) -> Iterator[Entry]:
    """The entries of a binary list: `read` has the place of one, and returns that of the next."""
    content, number, end = found(file.parent, file.name, file, "a file").read_bytes(), 0, 8
    try:
        for number in range(*struct.unpack_from("<Q", content)):
            words, end = read(content, end)
            if end > len(content):
                raise ValueError("it ends")
            yield f"{file}: entry {number}", words
    except (struct.error, ValueError, OverflowError) as error:
        raise unexpected(file, "a whole list", f"a damaged one, at entry {number}") from error


def _camera(content: bytes, at: int) -> Found:
    import pycolmap

    camera_id, number, width, height = struct.unpack_from("<IiQQ", content, at)
    models = {int(model): model for model in pycolmap.CameraModelId.__members__.values()}
    if number not in models or number < 0:
        raise ValueError("no camera model")
    count = len(pycolmap.Camera.create_from_model_id(1, models[number], 1.0, 1, 1).params)
    params = struct.unpack_from(f"<{count}d", content, at + 24)
    return [camera_id, models[number].name, width, height, *params], at + 24 + 8 * count


def _image(content: bytes, at: int) -> Found:
    end = content.index(0, at + 64)  # of its name
    (keypoints,) = struct.unpack_from("<Q", content, end + 1)
    words = struct.unpack_from("<7dI", content, at + 4)
    return [*words, content[at + 64 : end].decode(errors="replace")], end + 9 + 24 * keypoints


def _point(content: bytes, at: int) -> Found:
    (track,) = struct.unpack_from("<Q", content, at + 43)
    return [*struct.unpack_from("<3d", content, at + 8)], at + 51 + 8 * track

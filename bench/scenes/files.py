"""Reads the files of a data set; every error says where it occurred.

The argument `where` is the start of an error message: the file, and the field inside it.
"""

import math
import sys
from collections import ChainMap
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from bench.errors import SteerbenchError, not_there, unexpected
from bench.scenes.remarks import Remarks

SMALLEST_ANGLE = 1e-9  # of view in radians: below any telescope's, but its tangent is not 0
ORTHONORMAL_TOLERANCE = 1e-3  # largest entry of R^T R - I; poses have at least three digits
ROUNDED_TOLERANCE = 0.02  # the same of rotations with two digits, put right if a line says so


def data_folder(path: str | Path) -> Path:
    """The data set's folder with all links resolved; SteerbenchError if it is not a folder."""
    root = Path(path).expanduser()
    if not root.is_dir():
        raise not_there(root, "a folder")
    return root.resolve()


class Fields(ChainMap[str, Any]):
    """The fields of an object in a file, and those of the objects around it that it lacks. Errors
    begin with `where` it is."""

    def __init__(self, where: str, *levels: Any) -> None:
        super().__init__(*levels)
        self.where = where

    def place(self, name: str) -> str:
        return f"{self.where}.{name}"

    def wrong(self, name: str, expected: str) -> SteerbenchError:
        """The error about a field that is not what is `expected`."""
        return unexpected(self.place(name), expected, describe(self.get(name)))

    def number(self, name: str, low: float = -math.inf, usual: float | None = None) -> float:
        """As `number`; without the field, what is `usual`."""
        return number(self.get(name, usual), self.place(name), low)

    def size(self, name: str, usual: int | None = None) -> int:
        """A whole number from 1 on; without the field, what is `usual`."""
        return whole_number(self.get(name, usual), self.place(name), 1)

    def numbers(self, name: str, count: int) -> list[float]:
        return numbers_of(self.get(name), count, self.place(name))

    def pose(self, name: str, remarks: Remarks) -> Tensor:
        return rigid_pose(self.get(name), self.place(name), remarks)


def entries_of(record: Mapping, name: str, path: Path) -> list[Fields]:
    """The objects in the list `name`, at least one, with what `record` has beside them."""
    entries = record.get(name)
    if not isinstance(entries, list) or not entries:
        raise unexpected(f"{path}: {name}", "a list with at least one entry", describe(entries))
    placed = []
    for number, entry in enumerate(entries):
        where = f"{path}: {name}[{number}]"
        if not isinstance(entry, dict):
            raise unexpected(where, "an object", describe(entry))
        placed.append(Fields(where, entry, record))
    return placed


def frames_of(record: Mapping, path: Path) -> list[Fields]:
    """The frames of a `transforms*.json` as from `entries_of`, each with a `file_path`."""
    frames = entries_of(record, "frames", path)
    for frame in frames:
        file = frame.maps[0].get("file_path")
        if not isinstance(file, str) or not file:
            raise unexpected(frame.place("file_path"), "a path", describe(file))
    return frames


def _real(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def number(value: Any, where: str, low: float = -math.inf, high: float = math.inf) -> float:
    """A finite number with low < value < high."""
    # Compare before converting: an integer of hundreds of digits overflows a float.
    if _real(value) and low < value < high and abs(value) < sys.float_info.max:
        return float(value)
    limits = [f"above {low:g}"] * (low > -math.inf) + [f"below {high:g}"] * (high < math.inf)
    expected = f"a finite number {' and '.join(limits)}".rstrip()
    raise unexpected(where, expected, describe(value))


def focal_length(angle: object, size: float, where: str) -> float:
    """Focal length in pixels of a view of `angle` radians across `size` pixels."""
    return size / 2 / math.tan(number(angle, where, SMALLEST_ANGLE, math.pi) / 2)


def whole_number(value: Any, where: str, low: int) -> int:
    """A whole number, at least `low`; 3.0 is one, too."""
    if _real(value) and low <= value <= sys.maxsize and value == int(value):
        return int(value)
    raise unexpected(where, f"a whole number from {low} on", describe(value))


def numbers_of(value: object, count: int, where: str) -> list[float]:
    """The finite numbers in a list of `count`."""
    if not isinstance(value, list) or len(value) != count:
        raise unexpected(where, f"{count} numbers", describe(value))
    return [number(x, where) for x in value]


def numbers(text: str, where: str | Path) -> list[list[float]]:
    """The numbers of a text, line by line, without empty lines."""
    try:
        lines = (line.split() for line in text.splitlines())
        return [[float(word) for word in words] for words in lines if words]
    except ValueError as error:
        raise unexpected(where, "numbers", error) from error


def matrix(value: object, where: str) -> Tensor:
    """A matrix [3, 4] float64 from a list of 4x4 or 3x4 numbers, nested or not."""
    rows = value if isinstance(value, list) else []
    if len(rows) in (12, 16):
        rows = [rows[start : start + 4] for start in range(0, len(rows), 4)]
    if len(rows) not in (3, 4) or any(not isinstance(r, list) or len(r) != 4 for r in rows):
        raise unexpected(where, "a 4x4 matrix", describe(value))
    cells = [[number(x, f"{where}[{i}][{j}]") for j, x in enumerate(r)] for i, r in enumerate(rows)]
    if len(cells) == 4 and cells[3] != [0, 0, 0, 1]:
        raise unexpected(f"{where}[3]", "[0, 0, 0, 1]", cells[3])
    return torch.tensor(cells[:3], dtype=torch.float64)


def rigid_pose(value: object, where: str, remarks: Remarks) -> Tensor:
    """A `matrix` that is a rigid, right-handed camera-to-world pose.

    Of a rotation with two digits, or with a uniform scale, which readers that normalise rays do not
    see, the nearest is taken.
    """
    pose = matrix(value, where)
    rotation = pose[:, :3]
    off, scale = _off(rotation), rotation.norm().item() / math.sqrt(3)
    if not min(off, _off(rotation / scale)) <= ROUNDED_TOLERANCE:  # nor NaN
        raise unexpected(where, "an orthonormal rotation", f"one that is off by {off:.2g}")
    if torch.linalg.det(rotation) < 0:
        raise unexpected(where, "a right-handed rotation", "a mirrored one")
    if off <= ORTHONORMAL_TOLERANCE:
        return pose
    kind = "scaled or rounded rotation, taking the nearest without its scale"
    remarks.add(where, kind, f"{scale:.4g}")
    left, _, right = torch.linalg.svd(rotation / scale)
    return torch.cat((left @ right, pose[:, 3:]), dim=1)


def _off(rotation: Tensor) -> float:
    """By how much a matrix [3, 3] is not orthonormal."""
    return (rotation.T @ rotation - torch.eye(3, dtype=torch.float64)).abs().max().item()


def opengl_to_opencv(pose: Tensor) -> Tensor:
    """Convert camera-to-world [3, 4] from OpenGL axes (y up, z back) to OpenCV (down, forward)."""
    return pose * pose.new_tensor((1, -1, -1, 1))


def describe(value: object) -> str:
    """Format a value for an error message: shortened; a container is described by its type."""
    if isinstance(value, list | dict):
        return f"{type(value).__name__} of {len(value)}"
    return "nothing" if value is None else repr(value)

"""Pictures, poses, and a small NeRF-Synthetic folder to break."""

import io
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from bench.cameras import look_at
from bench.types import Camera
from tests.common import read_json, write_json


def camera_at(eye: tuple[float, float, float], size: int = 96) -> Camera:
    """A camera of size x size pixels that looks at the origin, z up."""
    c2w = look_at(torch.tensor(eye), torch.zeros(3), torch.tensor((0.0, 0.0, 1.0)))
    return Camera(c2w, 1.3 * size, 1.3 * size, size / 2, size / 2, size, size)


def intrinsics(camera: Camera) -> tuple[float, float, float, float]:
    return camera.fx, camera.fy, camera.cx, camera.cy


def png(header: bytes, data: bytes) -> bytes:
    """A PNG of a header and compressed rows that need not suit one another."""
    chunks = ((b"IHDR", header), (b"IDAT", zlib.compress(data)), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
        for kind, body in chunks
    )


def encoded(
    mode: str, kind: str = "PNG", size: tuple[int, int] = (8, 6), colour: int | tuple = 0
) -> bytes:
    """The file of a picture of one colour."""
    file = io.BytesIO()
    Image.new(mode, size, colour).save(file, kind)
    return file.getvalue()


def picture(seed: int, width: int = 8, height: int = 6, channels: int = 4) -> np.ndarray:
    """Random 8-bit values [height, width, channels] for a seed."""
    generator = np.random.default_rng(seed)
    return generator.integers(0, 256, (height, width, channels), dtype=np.uint8)


def pose(k: int) -> list[list[float]]:
    """OpenGL camera-to-world, 4x4, 4 units from 0 and looking at it from four sides; z is up."""
    c, s = [(1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)][k % 4]
    return [[c, 0, s, 4 * s], [s, 0, -c, -4 * c], [0, 1, 0, 0.0], [0, 0, 0, 1]]


def edit_json(path: Path, change: Callable[[dict], object]) -> None:
    record = read_json(path)
    change(record)
    write_json(path, record)


@pytest.fixture
def blender_folder(tmp_path) -> Path:
    """Three training and two test pictures of 8 x 6."""
    root = tmp_path / "chair"
    for split, count, seed in (("train", 3, 0), ("test", 2, 50)):
        (root / split).mkdir(parents=True)
        frames = []
        for k in range(count):
            Image.fromarray(picture(seed + k)).save(root / split / f"r_{k}.png")
            frames.append({"file_path": f"./{split}/r_{k}", "transform_matrix": pose(k)})
        record = {"camera_angle_x": 0.7, "frames": frames}
        write_json(root / f"transforms_{split}.json", record)
    return root

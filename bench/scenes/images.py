"""Pictures of a data set: read once, decoded in parallel, kept as 8-bit tensors."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from bench.cameras import crop_camera, scale_camera
from bench.scenes.distortion import Lens, undistort
from bench.scenes.files import unexpected
from bench.scenes.parallel import in_parallel
from bench.types import Camera, Log

MOST_PIXELS = 1 << 26
"""Of a picture: decoded, converted and copied it takes 12 bytes a pixel, 0.8 GB. A header of a few
bytes can announce more than any machine holds."""


@dataclass(frozen=True)
class View:
    """A picture that a data set describes: `camera` in the data set's units, OpenCV axes, float64,
    because a scene may lie far from its data set's origin.

    `lens` is None for a pinhole.
    """

    name: str
    path: Path
    camera: Camera
    lens: Lens | None = None


@dataclass(frozen=True)
class Picture:
    """A decoded view: `image` uint8 [H, W, 3 or 4], its pinhole `camera`, hash of its file."""

    image: Tensor
    camera: Camera
    sha256: str


@contextmanager
def opened(source: Path | io.BytesIO, where: Path) -> Iterator[Image.Image]:
    """The picture in `source`, of which nothing but the header was read yet.

    Raises:
        SteerbenchError: it is none, or too large, or turns out to be damaged while it is used.
    """
    try:
        with Image.open(source) as image:
            if image.width * image.height > MOST_PIXELS:
                size = f"{image.width} x {image.height}"
                raise unexpected(where, f"a picture of at most {MOST_PIXELS:,} pixels", size)
            yield image
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise unexpected(where, "a whole picture", error) from error


def image_size(path: Path) -> tuple[int, int]:
    """Width and height in pixels, from the file's header alone."""
    with opened(path, path) as image:
        return image.size


def decode_all(views: Sequence[View], downscale: int, log: Log) -> list[Picture]:
    """Read, undistort and downscale every view, in parallel; the order stays."""
    return in_parallel(lambda view: decode(view, downscale), views, "decode pictures", log)


def decode(view: View, downscale: int) -> Picture:
    """One view as a pinhole picture at 1 / downscale of its resolution."""
    content = contents(view.path)
    image = decode_bytes(content, view.path)
    camera = view.camera
    if image.shape[:2] != (camera.height, camera.width):
        expected = f"{camera.width} x {camera.height} pixels"
        raise unexpected(view.path, expected, f"{image.shape[1]} x {image.shape[0]}")
    if view.lens:
        image, camera = undistort(image, camera, view.lens, view.path)
    image, camera = shrink(image, camera, downscale, view.path)
    return Picture(image, camera, hashlib.sha256(content).hexdigest())


def contents(path: Path) -> bytes:
    """The bytes of a picture's file."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise unexpected(path, "a readable picture", error) from error


def decode_bytes(content: bytes, path: Path) -> Tensor:
    """The 8-bit picture in `content` as uint8 [H, W, 3], or [H, W, 4] when it has an alpha."""
    with opened(io.BytesIO(content), path) as image:
        if image.mode.startswith(("I", "F")):
            raise unexpected(path, "8 bits a channel", f"mode {image.mode}")
        if image.mode == "P" and image.palette is None:
            raise unexpected(path, "a palette beside numbers of colours", "none")
        mode = "RGBA" if image.has_transparency_data else "RGB"
        return torch.from_numpy(np.array(image.convert(mode)))


def shrink(image: Tensor, camera: Camera, factor: int, where: Path) -> tuple[Tensor, Camera]:
    """Average blocks of `factor` x `factor` pixels; colours weigh by their alpha.

    Columns and rows that do not fill a block, at the right and the bottom, are left out, so that
    the camera of what remains is exact. Means are rounded to the nearest 8-bit value.
    """
    if factor == 1:
        return image, camera
    height, width = camera.height // factor, camera.width // factor
    if not height or not width:
        got = f"{camera.width} x {camera.height}"
        raise unexpected(where, f"at least {factor} x {factor} pixels for this downscale", got)
    blocks = image[: height * factor, : width * factor].long()
    blocks = blocks.reshape(height, factor, width, factor, -1)
    if image.shape[2] == 3:
        small = rounded_ratio(blocks.sum((1, 3)), torch.tensor(factor**2))
    else:
        alpha = blocks[..., 3:]
        mass = alpha.sum((1, 3))
        colour = rounded_ratio((blocks[..., :3] * alpha).sum((1, 3)), mass.clamp(min=1))
        small = torch.cat((colour, rounded_ratio(mass, torch.tensor(factor**2))), dim=-1)
    camera = crop_camera(camera, 0, 0, width * factor, height * factor)
    return small.to(torch.uint8), scale_camera(camera, width, height)


def rounded_ratio(numerator: Tensor, denominator: Tensor) -> Tensor:
    """numerator / denominator of integers, rounded to the nearest integer, halves up."""
    return (2 * numerator + denominator) // (2 * denominator)

"""Pictures of a data set, decoded on demand and kept as 8-bit tensors."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from bench.cameras import crop_camera, scale_camera
from bench.errors import unexpected
from bench.scenes.distortion import Lens, undistort, undistorted_camera
from bench.threads import in_parallel
from bench.types import Camera, Log

MOST_PIXELS = 1 << 26
"""Upper limit for a picture: decoding takes 12 bytes per pixel, and a header of a few bytes can
announce more than any machine can hold."""


@dataclass(frozen=True)
class View:
    """A picture that a data set describes.

    `camera` is in the data set's units, with OpenCV axes, in float64 because a scene may lie far
    from the origin. `lens` is None for a pinhole.
    """

    name: str
    path: Path
    camera: Camera
    lens: Lens | None = None


@dataclass(frozen=True)
class Picture:
    """A view at 1 / `downscale` of its resolution, not decoded: its pinhole, its file's hash."""

    view: View
    downscale: int
    camera: Camera
    sha256: str


class Pictures(Sequence[Tensor]):
    """The pixels of the `described` pictures, uint8 [H, W, 3 or 4] each.

    Decoded on first access and kept; iteration decodes all in parallel. Raises SteerbenchError if a
    file is damaged, or has changed since it was described.
    """

    def __init__(self, described: Sequence[Picture], log: Log) -> None:
        self.described, self._log = described, log
        self._decoded: dict[int, Tensor] = {}

    def __len__(self) -> int:
        return len(self.described)

    def __getitem__(self, place: Any) -> Any:
        index = range(len(self))[place]
        return self._at(index) if isinstance(index, int) else [self._at(i) for i in index]

    def __iter__(self) -> Iterator[Tensor]:
        missing = [index for index in range(len(self)) if index not in self._decoded]
        if missing:
            in_parallel(self._at, missing, "decode pictures", self._log)
        return iter(self[:])

    def _at(self, index: int) -> Tensor:
        if index not in self._decoded:  # two threads may both decode it, with equal results
            self._decoded[index] = decode(self.described[index])
        return self._decoded[index]


@contextmanager
def opened(source: Path | io.BytesIO, where: Path) -> Iterator[Image.Image]:
    """The picture in `source`, with only its header read.

    Raises SteerbenchError if it is no picture, too large, or found to be damaged while it is used.
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
    """Width and height in pixels, read from the file's header only."""
    with opened(path, path) as image:
        return image.size


def describe(view: View, downscale: int) -> Picture:
    """Describe a view as a `Picture`; raises if it is none, of another size, or too small."""
    content, camera = contents(view.path), view.camera
    with opened(io.BytesIO(content), view.path) as image:
        check_mode(image, view.path)
        if image.size != (camera.width, camera.height):
            expected = f"{camera.width} x {camera.height} pixels"
            raise unexpected(view.path, expected, f"{image.width} x {image.height}")
    if view.lens:
        camera = undistorted_camera(camera, view.lens, view.path)
    camera = shrunk_camera(camera, downscale, view.path)
    return Picture(view, downscale, camera, hashlib.sha256(content).hexdigest())


def decode(picture: Picture) -> Tensor:
    """Decode the pixels of a picture, as `Pictures` returns them."""
    view, content = picture.view, contents(picture.view.path)
    if hashlib.sha256(content).hexdigest() != picture.sha256:
        raise unexpected(view.path, "the picture that was there at the start", "another one")
    image = decode_bytes(content, view.path)
    if view.lens:
        image = undistort(image, view.camera, view.lens, view.path)
    return shrink(image, picture.downscale)


def contents(path: Path) -> bytes:
    """The bytes of a picture's file; SteerbenchError if it cannot be read."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise unexpected(path, "a readable picture", error) from error


def decode_bytes(content: bytes, path: Path) -> Tensor:
    """Decode the 8-bit picture in `content` to uint8 [H, W, 3], or [H, W, 4] if it has alpha."""
    with opened(io.BytesIO(content), path) as image:
        check_mode(image, path)
        if image.mode == "P" and image.palette is None:
            raise unexpected(path, "a palette beside numbers of colours", "none")
        mode = "RGBA" if image.has_transparency_data else "RGB"
        return torch.from_numpy(np.array(image if image.mode == mode else image.convert(mode)))


def check_mode(image: Image.Image, path: Path) -> None:
    """Raise unless the picture has 8 bits per channel."""
    if image.mode.startswith(("I", "F")):
        raise unexpected(path, "8 bits a channel", f"mode {image.mode}")
    # Pillow reads 16 bits of colour as 8 and says so only in the raw mode of its decoder.
    if any(";16" in str(tile) for tile in getattr(image, "tile", ())):
        raise unexpected(path, "8 bits a channel", "16")


def shrink(image: Tensor, factor: int) -> Tensor:
    """Average blocks of `factor` x `factor` pixels, colours weighted by alpha, rounded to 8 bits.

    Columns and rows at the right and bottom that do not fill a block are dropped.
    """
    if factor == 1:
        return image
    height, width = image.shape[0] // factor, image.shape[1] // factor
    blocks = image[: height * factor, : width * factor].long()
    blocks = blocks.reshape(height, factor, width, factor, -1)
    whole = torch.tensor(factor**2)

    def ratio(numerator: Tensor, denominator: Tensor) -> Tensor:
        return (2 * numerator + denominator) // (2 * denominator)  # rounded, halves up

    if image.shape[2] == 3:
        small = ratio(blocks.sum((1, 3)), whole)
    else:
        alpha = blocks[..., 3:]
        mass = alpha.sum((1, 3))
        colour = ratio((blocks[..., :3] * alpha).sum((1, 3)), mass.clamp(min=1))
        small = torch.cat((colour, ratio(mass, whole)), dim=-1)
    return small.to(torch.uint8)


def shrunk_camera(camera: Camera, factor: int, where: Path) -> Camera:
    """The exact camera of a picture after `shrink`; raises if it is smaller than a block."""
    if factor == 1:
        return camera
    width, height = camera.width // factor, camera.height // factor
    if not height or not width:
        got = f"{camera.width} x {camera.height}"
        raise unexpected(where, f"at least {factor} x {factor} pixels for this downscale", got)
    return scale_camera(crop_camera(camera, 0, 0, width * factor, height * factor), width, height)

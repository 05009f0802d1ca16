"""Pictures of a data set, decoded on demand and kept as 8-bit tensors, without what a lens did.

A lens is a function from points [N, 2] (float64) on a pinhole's image plane at distance 1 to where
the lens shows them in that plane. It is hashable. A picture is undistorted to that of a pinhole
with the same intrinsics.
"""

import hashlib
import io
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from kornia.geometry.calibration import distort_points
from kornia.geometry.camera import distort_points_kannala_brandt
from kornia.geometry.transform import remap
from PIL import Image, ImageOps, UnidentifiedImageError
from torch import Tensor

from bench.cameras import crop_camera, pixel_grid, scale_camera
from bench.errors import not_there, unexpected
from bench.kinds import Size
from bench.threads import in_parallel
from bench.types import Camera, Log

Lens = Callable[[Tensor], Tensor]

ASPECT = 100  # the aspect ratios of a picture and its camera differ by at most one part in so many

MOST_PIXELS = 1 << 26
"""Upper limit for a picture: decoding takes 12 bytes per pixel, and a header of a few bytes can
announce more than any machine can hold."""


@dataclass(frozen=True)
class View:
    """A picture that a data set describes."""

    name: str
    path: Path
    camera: Camera  # in the data set's units, in float64: a scene may lie far from the origin
    lens: Lens | None = None  # None: a pinhole
    mask: Path | None = None  # a picture, black where pixels do not count
    hides: bool = False  # the mask is white there, as those of instant-ngp are
    stored: bool = False  # whether the camera is of the pixels as stored, whatever EXIF says


@dataclass(frozen=True)
class ScaledView:
    """A view at 1 / `downscale` of its resolution, not decoded: its pinhole, its file's hash."""

    view: View
    downscale: int
    camera: Camera
    sha256: str
    clear: bool  # whether it says how transparent its pixels are
    seen: Size  # the size of what of it is left without its lens
    mask: "ScaledView | None" = None  # in full size, with the lens
    turned: bool | None = None  # whether its EXIF orientation is obeyed; None: it is upright


class Pictures(Sequence[Tensor]):
    """The pixels of the `described` pictures, uint8 [H, W, 3 or 4] each.

    Decoded on first access and kept; iteration decodes all in parallel. Raises SteerbenchError if a
    file is damaged, or has changed since it was described.
    """

    def __init__(self, described: Sequence[ScaledView], log: Log) -> None:
        self.described, self.log = described, log
        self._decoded: dict[int, Tensor] = {}

    def __len__(self) -> int:
        return len(self.described)

    def __getitem__(self, place: Any) -> Any:
        index = range(len(self))[place]
        return self._at(index) if isinstance(index, int) else [self._at(i) for i in index]

    def __iter__(self) -> Iterator[Tensor]:
        missing = [index for index in range(len(self)) if index not in self._decoded]
        if missing:
            in_parallel(self._at, missing, "decode pictures", self.log)
        return iter(self[:])

    def _at(self, index: int) -> Tensor:
        if index not in self._decoded:  # two threads may both decode it, with equal results
            self._decoded[index] = self._read(self.described[index])
        return self._decoded[index]

    def _read(self, picture: ScaledView) -> Any:
        return decode(picture)


@contextmanager
def opened(source: Path | io.BytesIO, where: Path) -> Iterator[Image.Image]:
    """The picture in `source`, header read; raises if it is none, too large, or damaged."""
    try:
        with Image.open(source) as image:
            if image.width * image.height > MOST_PIXELS:
                size = f"{image.width} x {image.height}"
                raise unexpected(where, f"a picture of at most {MOST_PIXELS:,} pixels", size)
            yield image
    except UnidentifiedImageError as error:
        got = f"one that Pillow does not read ({where.suffix})"
        raise unexpected(where, "a whole picture of 8 bits a channel, such as PNG", got) from error
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise unexpected(where, "a whole picture", error) from error


def orientation(image: Image.Image) -> int:
    """EXIF's, 1 (upright) to 8; from 5 on it exchanges the sides. Pillow itself turns a TIFF."""
    with suppress(Exception):  # there is none, or a damaged one
        number = Image.Image.getexif(image)[0x112]  # PNG's own method decodes the picture
        return int(number) if number in range(1, 9) and image.format != "TIFF" else 1
    return 1


def image_size(path: Path, like: Size | None = None) -> Size:
    """Width and height in pixels, read from the file's header only, as viewers show it; with a size
    that it is to be `like`, as stored if that has the same shape."""
    with opened(path, path) as image:
        shown = image.size[::-1] if orientation(image) > 4 else image.size
        shape = like[0] / like[1] if like else 0
        return min(image.size, shown, key=lambda x: abs(x[0] / x[1] - shape)) if like else shown


def fitted_camera(camera: Camera, path: Path) -> Camera:
    """The same view at the size of the picture in `path`, which may be a reduced one."""
    width, height = image_size(path, camera.size)
    if ASPECT * abs(width * camera.height - height * camera.width) > height * camera.width:
        expected = f"{camera.width} x {camera.height} pixels, or as wide for its height"
        raise unexpected(path, f"a picture of {expected}", f"{width} x {height}")
    return scale_camera(camera, width, height)


def describe(view: View, downscale: int) -> ScaledView:
    """Describe a view as a `ScaledView`; raises if it is none, of another size, or too small."""
    content = contents(view.path)
    camera = view.camera
    with opened(io.BytesIO(content), view.path) as image:
        check_mode(image, view.path)
        turned = obeyed(image, view)
        clear = image.has_transparency_data
        size = image.size[::-1] if turned and orientation(image) > 4 else image.size
        if size != camera.size:
            expected = f"{camera.width} x {camera.height} pixels"
            raise unexpected(view.path, expected, "{} x {}".format(*size))
    seen = size
    if view.lens:
        camera = undistorted_camera(camera, view.lens, view.path)
        source, _, _ = _window(view.camera, view.lens)
        width, height = (source.amax((0, 1)) - source.amin((0, 1))).round().long().tolist()
        seen = width + 1, height + 1
    camera = shrunk_camera(camera, downscale, view.path)
    mask = describe(View(view.name, view.mask, view.camera), 1) if view.mask else None
    sha256 = hashlib.sha256(content).hexdigest()
    return ScaledView(view, downscale, camera, sha256, clear, seen, mask, turned)


def obeyed(image: Image.Image, view: View) -> bool | None:
    """Whether the EXIF orientation of a picture is obeyed; None if it is upright. Programs that
    find cameras often ignore it: the camera's size decides. Raises if that cannot."""
    if (number := orientation(image)) == 1:
        return None
    if number > 4 and image.width != image.height:
        return image.size != view.camera.size
    if not view.stored:
        how = "turn the pixels (mogrify -auto-orient) or remove it (exiftool -Orientation=)"
        got = f"EXIF orientation {number}, which the camera may mean or not: {how}"
        raise unexpected(view.path, "pixels that are stored upright", got)
    return False


def decode(picture: ScaledView) -> Tensor:
    """Decode the pixels of a picture, as `Pictures` returns them."""
    view, content = picture.view, contents(picture.view.path)
    if hashlib.sha256(content).hexdigest() != picture.sha256:
        raise unexpected(view.path, "the picture that was there at the start", "another one")
    image = decode_bytes(content, view.path, upright=bool(picture.turned))
    if view.lens:
        image = undistort(image, view.camera, view.lens)
    return shrink(image, picture.downscale)


def contents(path: Path) -> bytes:
    """The bytes of a picture's file; SteerbenchError if it cannot be read."""
    try:
        return path.read_bytes()
    except OSError as error:
        if not path.exists():
            raise not_there(path, "a picture") from error
        raise unexpected(path, "a readable picture", error.strerror) from error


def decode_bytes(content: bytes, path: Path, upright: bool = True) -> Tensor:
    """Decode the 8-bit picture in `content` to uint8 [H, W, 3], or [H, W, 4] if it has alpha;
    turned `upright` as viewers show it, or as it is stored."""
    with opened(io.BytesIO(content), path) as image:
        check_mode(image, path)
        if upright and orientation(image) > 1:
            image = ImageOps.exif_transpose(image)
        if image.mode == "P" and image.palette is None:
            raise unexpected(path, "a palette beside numbers of colours", "none")
        mode = "RGBA" if image.has_transparency_data else "RGB"
        return torch.from_numpy(np.array(image if image.mode == mode else image.convert(mode)))


def check_mode(image: Image.Image, path: Path) -> None:
    """Raise unless it is one picture of 8 bits a channel."""
    # The further pictures of a camera's JPEG (MPO) are previews, depth or gain maps.
    if image.format != "MPO" and getattr(image, "is_animated", False):
        raise unexpected(path, "one picture", "several: an animation, or pages")
    if image.mode.startswith(("I", "F")):
        kind = {"F": "floats", "I": "32"}.get(image.mode, "16")
        raise unexpected(path, "8 bits a channel", f"{kind} (mode {image.mode})")
    # Pillow reads 16 bits of colour as 8 and says so only in the raw mode of its decoder.
    if any(";16" in str(tile) for tile in getattr(image, "tile", ())):
        raise unexpected(path, "8 bits a channel", "16")


def shrink(image: Tensor, factor: int) -> Tensor:
    """Average blocks of `factor`^2 pixels, weighted by alpha, to 8 bits; drops incomplete ones."""
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
    width, height = camera.width // factor, camera.height // factor
    if not height or not width:
        got = f"{camera.width} x {camera.height}"
        raise unexpected(where, f"at least {factor} x {factor} pixels for this downscale", got)
    return scale_camera(crop_camera(camera, 0, 0, width * factor, height * factor), width, height)


@dataclass(frozen=True)
class RadialTangential:
    """OpenCV's lens with `coefficients` (k1, k2, p1, p2, k3), optionally also (k4, k5, k6)."""

    coefficients: tuple[float, ...]

    def __call__(self, points: Tensor) -> Tensor:
        return distort_points(points, torch.eye(3).double(), points.new_tensor(self.coefficients))


@dataclass(frozen=True)
class Fisheye:
    """OpenCV's fisheye (Kannala and Brandt 2006) with `coefficients` (k1, k2, k3, k4)."""

    coefficients: tuple[float, ...]

    def __call__(self, points: Tensor) -> Tensor:
        plain = (1.0, 1.0, 0.0, 0.0)  # fx, fy, cx, cy
        return distort_points_kannala_brandt(points, points.new_tensor(plain + self.coefficients))


def undistort(image: Tensor, camera: Camera, lens: Lens) -> Tensor:
    """Undistort `image`, uint8 [H, W, C], to the pinhole picture of `undistorted_camera`.

    `camera` has the intrinsics of both. ValueError if the distortion cannot be undone.
    """
    source, _, _ = _window(camera, lens)
    planes = image.permute(2, 0, 1)[None].float()
    alpha = planes[:, 3:] / 255
    planes[:, :3] *= alpha if alpha.numel() else 1  # interpolate premultiplied colours
    # kornia's origin is the centre of the first pixel, ours is its corner.
    u, v = (source - 0.5).unbind(-1)
    planes = remap(planes, u[None], v[None], align_corners=True)
    alpha = planes[:, 3:] / 255
    planes[:, :3] /= alpha.clamp(min=1e-6) if alpha.numel() else 1
    return planes[0].permute(1, 2, 0).round().clamp(0, 255).to(torch.uint8).contiguous()


def undistorted_camera(camera: Camera, lens: Lens, where: Path) -> Camera:
    """The camera of the undistorted picture, cropped to where the lens saw every pixel."""
    try:
        source, left, top = _window(camera, lens)
    except ValueError as error:
        expected = "a lens distortion that can be undone"
        raise unexpected(where, expected, f"{lens}: {error}") from error
    return crop_camera(camera, left, top, source.shape[1], source.shape[0])


def _window(camera: Camera, lens: Lens) -> tuple[Tensor, int, int]:
    return pinhole_window(*camera.size, camera.intrinsics, lens)


@lru_cache(maxsize=2)  # most captures have one lens
def pinhole_window(
    width: int, height: int, intrinsics: tuple[float, float, float, float], lens: Lens
) -> tuple[Tensor, int, int]:
    """Positions [h, w, 2] as (u, v) in the distorted picture of the pinhole pixels inside it, and
    the column and row of the first of these; ValueError if the distortion cannot be undone."""
    focal, centre = torch.tensor(intrinsics, dtype=torch.float64).split(2)
    points = lens((pixel_grid(width, height).double() - centre) / focal)
    source = (points * focal + centre).reshape(height, width, 2).float()
    across, down = source[:-1, 1:] - source[:-1, :-1], source[1:, :-1] - source[:-1, :-1]
    area = across[..., 0] * down[..., 1] - across[..., 1] * down[..., 0]  # of distorted cells
    if not (area > 0).all():  # also False for NaN
        raise ValueError("it folds the picture over itself")
    left, top, right, bottom = seen_rectangle(source)
    return source[top:bottom, left:right], left, top


def seen_rectangle(source: Tensor) -> tuple[int, int, int, int]:
    """(left, top, right, bottom) of a rectangle that was seen: drops the worst side in turn."""
    height, width = source.shape[:2]
    limit = source.new_tensor((width, height)) - 0.5  # last pixel centre: bilinear needs no border
    unseen = ~((source >= 0.5) & (source <= limit)).all(-1).numpy()  # True for NaN, too
    left, top, right, bottom = 0, 0, width, height
    while left < right and top < bottom:
        inside = unseen[top:bottom, left:right]
        if not inside.any():
            return left, top, right, bottom
        sides = inside[:, 0], inside[0], inside[:, -1], inside[-1]
        shares = [side.mean() for side in sides]
        worst = shares.index(max(shares))
        left, top = left + (worst == 0), top + (worst == 1)
        right, bottom = right - (worst == 2), bottom - (worst == 3)
    raise ValueError("it leaves no pixel")

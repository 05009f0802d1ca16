"""Lenses, and how to undistort a picture to that of a pinhole with the same intrinsics.

A lens is a function from points [N, 2] (float64) on a pinhole's image plane at distance 1 to where
the lens shows them in that plane. It is hashable.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import torch
from kornia.geometry.calibration import distort_points
from kornia.geometry.camera import distort_points_kannala_brandt
from kornia.geometry.transform import remap
from torch import Tensor
from torch.nn.functional import pad

from bench.cameras import crop_camera, pixel_grid
from bench.errors import unexpected
from bench.types import Camera

Lens = Callable[[Tensor], Tensor]


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


def undistort(image: Tensor, camera: Camera, lens: Lens, where: Path) -> Tensor:
    """Undistort `image`, uint8 [H, W, C], to the pinhole picture of `undistorted_camera`.

    `camera` has the intrinsics of both pictures; `where` names the picture in messages.
    Raises SteerbenchError if the lens folds the picture over itself.
    """
    source, _, _ = _window(camera, lens, where)
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
    """The camera of the undistorted picture; arguments and errors are those of `undistort`.

    It is cropped to a rectangle in which the lens saw every pixel, so that no border is invented.
    """
    source, left, top = _window(camera, lens, where)
    return crop_camera(camera, left, top, source.shape[1], source.shape[0])


def _window(camera: Camera, lens: Lens, where: Path) -> tuple[Tensor, int, int]:
    intrinsics = (camera.fx, camera.fy, camera.cx, camera.cy)
    try:
        return pinhole_window(camera.width, camera.height, intrinsics, lens)
    except ValueError as error:
        expected = "a lens distortion that can be undone"
        raise unexpected(where, expected, f"{lens}: {error}") from error


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
    """(left, top, right, bottom) of a rectangle whose pixels all lie in the distorted picture.

    Starts from the whole picture and removes the side with the largest unseen share until the
    border has no unseen pixel.
    """
    height, width = source.shape[:2]
    limit = source.new_tensor((width, height)) - 0.5  # last pixel centre: bilinear needs no border
    unseen = ~((source >= 0.5) & (source <= limit)).all(-1)  # True for NaN, too
    # A summed-area table: every side of every rectangle costs the same.
    table = pad(unseen.int(), (1, 0, 1, 0)).cumsum(0).cumsum(1).numpy()

    def share(left: int, top: int, right: int, bottom: int) -> float:
        count = table[bottom, right] - table[top, right] - table[bottom, left] + table[top, left]
        return count / ((right - left) * (bottom - top))

    left, top, right, bottom = 0, 0, width, height
    while left < right and top < bottom:
        if not share(left, top, right, bottom):
            return left, top, right, bottom
        shares = (
            share(left, top, left + 1, bottom),
            share(left, top, right, top + 1),
            share(right - 1, top, right, bottom),
            share(left, bottom - 1, right, bottom),
        )
        worst = shares.index(max(shares))
        left, top = left + (worst == 0), top + (worst == 1)
        right, bottom = right - (worst == 2), bottom - (worst == 3)
    raise ValueError("it leaves no pixel")

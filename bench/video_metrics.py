"""Further metrics of a path: what its frames look like one after the other.

Pictures are float [H, W, 3] in [0, 1], as they are scored.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from bench.cameras import pixel_grid, project, unproject
from bench.types import Camera, check_shape

NEEDS = {
    "tpsnr": "the true pictures of two consecutive frames",
    "tlpips": "the true pictures of two consecutive frames, and LPIPS",
    "warp": "a frame as many frames earlier, without a cut between, and the depth of both",
}
"""The further metrics of a path, and what a figure of each needs."""

OFFSETS = (1, 7)  # frames between the two of a warping error: what blinks, and what drifts
SAME_SURFACE = 0.01
"""Two z-depths are of one surface if they differ by no more than this share. Neighbouring pixels of
a surface seen at 70 degrees do not, at 200 pixels across a field of view of 40 degrees."""


class DepthView(NamedTuple):
    """Where a frame was seen from, and the z-depth [H, W] of what it shows, +inf where empty."""

    camera: Camera
    depth: Tensor


def warping_error(
    image: Tensor, view: DepthView, earlier_image: Tensor, earlier: DepthView
) -> float:
    """Mean squared error of `image` and the earlier one, warped to it: E_warp of Lai et al. 2018.

    The depths give the flow of a still scene, and what was hidden: a pixel counts if all four
    between which its earlier place lies show the same surface. The mean is over these pixels and
    the channels; NaN without any. Also of true pictures it is not 0, because of highlights and
    resampling.
    """
    height, width = view.depth.shape
    check_shape("image", image, height, width, 3)
    seen = torch.isfinite(view.depth).flatten()
    pixels = pixel_grid(width, height)[seen]
    points = unproject(view.camera, pixels, view.depth.flatten()[seen])
    place, z = project(earlier.camera, points)  # [R, 2], [R]
    size = place.new_tensor(earlier.depth.shape).flip(0)
    low = (place - 0.5).floor()
    inside = (z > 0) & (low >= 0).all(dim=1) & (low + 1 < size).all(dim=1)
    place, z, (column, row) = place[inside], z[inside], low[inside].long().T
    around = torch.stack([earlier.depth[row + v, column + u] for v in (0, 1) for u in (0, 1)])
    same = ((around - z).abs() <= SAME_SURFACE * z).all(dim=0)
    if not same.any():
        return math.nan
    grid = (2 * place[same] / size - 1)[None, None]
    source = earlier_image.permute(2, 0, 1)[None].float()
    warped = torch.nn.functional.grid_sample(source, grid, align_corners=False)[0, :, 0].T
    kept = image.reshape(-1, 3)[seen][inside][same]
    return (kept.double() - warped.double()).square().mean().item()

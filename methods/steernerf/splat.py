"""Splats points into pixels: the reprojection of an earlier frame (Eq. 8, Eq. 10).

Pixel (i, j) covers [i, i+1) x [j, j+1), so a point at (u, v) lands only in (floor u, floor v).
"""

import torch
from torch import Tensor

from bench.types import check_shape


@torch.no_grad()
def splat(pixels: Tensor, depth: Tensor, width: int, height: int) -> Tensor:
    """Find the pixel of a width x height picture that shows each of N points: [N] int64, row by
    row, or width * height, one after the last, for a point that no pixel shows.

    The points have continuous coordinates (u, v) `pixels` [N, 2] and a z-depth `depth` [N]. A pixel
    shows the last point that lands there, whatever its depth: in SteerNeRF's release points
    overwrite each other. Only points inside the picture with a finite positive depth count. Not
    differentiable.
    """
    check_shape("depth", depth, None)
    check_shape("pixels", pixels, len(depth), 2)
    nowhere, (u, v) = width * height, pixels.unbind(dim=1)
    # Compared as floats, where comparisons with NaN are false; converting huge or non-finite
    # values to integers is undefined.
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    taken = inside & (depth > 0) & (depth < torch.inf)  # [N]
    # The point is rounded to a pixel; the conversion is floor, as coordinates are not negative.
    row, column = (torch.where(taken, x, 0).long() for x in (v, u))
    landed = torch.where(taken, row * width + column, nowhere)
    number = torch.arange(len(depth), dtype=torch.int32, device=pixels.device)
    last = number.new_full((nowhere + 1,), -1).scatter_reduce_(0, landed, number, "amax")
    return torch.where(last[landed] == number, landed, nowhere)

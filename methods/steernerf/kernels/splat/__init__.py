"""Splats points into pixels: the reprojection of an earlier frame (Eq. 8, Eq. 10).

Pixel (i, j) covers [i, i+1) x [j, j+1), so a point at (u, v) lands only in (floor u, floor v).
"""

import torch
from torch import Tensor

from bench.types import check_shape
from methods.kernels.dispatch import implementation


def splat(
    pixels: Tensor, depth: Tensor, width: int, height: int, *, backend: str = "auto"
) -> Tensor:
    """Find the pixel of a width x height picture that shows each of N points: [N] int64, row by
    row, or width * height, one after the last, for a point that no pixel shows.

    The points have continuous coordinates (u, v) `pixels` [N, 2] and a z-depth `depth` [N]. A pixel
    shows the last point that lands there, whatever its depth: in SteerNeRF's release points
    overwrite each other. Only points inside the picture with a finite positive depth count. Not
    differentiable.
    """
    check_shape("depth", depth, None)
    check_shape("pixels", pixels, len(depth), 2)
    chosen, nowhere = implementation(__name__, backend, pixels.device), width * height
    last = torch.full((nowhere + 1,), -1, dtype=torch.int32, device=pixels.device)
    landed = chosen.splat(pixels.detach(), depth.detach(), width, height, last)
    number = torch.arange(len(depth), dtype=torch.int32, device=pixels.device)
    return torch.where(last[landed] == number, landed, nowhere)

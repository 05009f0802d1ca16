"""Splats points into pixels: the reprojection of earlier frames.

Pixel (i, j) covers [i, i+1) x [j, j+1), so a point at (u, v) lands only in (floor u, floor v).
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate

import torch
from torch import Tensor

from bench.types import check_shape
from methods.kernels.dispatch import implementation


def splat(
    pixels: Tensor,
    depth: Tensor,
    counts: Sequence[int],
    width: int,
    height: int,
    *,
    backend: str = "auto",
) -> Tensor:
    """Find which of the points of several frames each pixel of a width x height picture shows:
    [frames, height, width] int32.

    The N points, `counts` of each frame, one frame after the other, have continuous coordinates
    (u, v) `pixels` [N, 2] and a z-depth `depth` [N]. An entry is the index, 0 to N - 1, of the last
    point of the frame that lands there, whatever its depth, -1 for none: in SteerNeRF's release
    points overwrite each other. Only points inside the picture with a finite positive depth count.
    Not differentiable.
    """
    check_shape("pixels", pixels, sum(counts), 2)
    check_shape("depth", depth, sum(counts))
    chosen = implementation(__name__, backend, pixels.device)
    index = torch.full((len(counts), height, width), -1, dtype=torch.int32, device=pixels.device)
    starts = accumulate(counts, initial=0)
    each = zip(pixels.detach().split(counts), depth.detach().split(counts), strict=True)
    for picture, first, points in zip(index, starts, each, strict=False):
        chosen.splat(*points, first, picture)
    return index

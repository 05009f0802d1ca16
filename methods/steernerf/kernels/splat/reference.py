"""Splatting in plain torch."""

from __future__ import annotations

import torch
from torch import Tensor


def splat(pixels: Tensor, depth: Tensor, first: int, index: Tensor) -> None:
    """Write `first` plus the number of the last point in each pixel into `index` [H, W], -1."""
    u, v = pixels.unbind(dim=1)
    height, width = index.shape
    # Compared as floats, where comparisons with NaN are false; converting huge or non-finite
    # values to integers is undefined.
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    taken = inside & (depth > 0) & (depth < torch.inf)  # [N]
    # Eq. 8, Eq. 10: the point is rounded to a pixel; the conversion is floor, because coordinates
    # are not negative. Points that no pixel shows leave -1 as it is, in the first one: to leave
    # them out, the host would have to wait for a GPU.
    row, column = (torch.where(taken, x, 0).long() for x in (v, u))
    point = torch.arange(first, first + len(depth), dtype=torch.int32, device=pixels.device)
    shown = torch.where(taken, point, -1)
    index.view(-1).scatter_reduce_(0, row * width + column, shown, "amax")

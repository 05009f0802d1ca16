"""Splatting in plain torch."""

from __future__ import annotations

import torch
from torch import Tensor


def splat(pixels: Tensor, depth: Tensor, width: int, height: int) -> Tensor:
    """The last point in each pixel."""
    u, v = pixels.unbind(dim=1)
    # Compared as floats, where comparisons with NaN are false; converting huge or non-finite
    # values to integers is undefined.
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    taken = inside & (depth > 0) & (depth < torch.inf)  # [N]
    # Eq. 8, Eq. 10: the point is rounded to a pixel; the conversion is floor, because coordinates
    # are not negative. Points that no pixel shows go to an extra bin: to leave them out, the host
    # would have to wait for a GPU.
    row, column = (torch.where(taken, x, 0).long() for x in (v, u))
    pixel = torch.where(taken, row * width + column, height * width)
    index = torch.full((height * width + 1,), -1, dtype=torch.int32, device=pixels.device)
    point = torch.arange(len(depth), dtype=torch.int32, device=pixels.device)
    index.scatter_reduce_(0, pixel, point, "amax")
    return index[:-1].view(height, width)


def gather(values: Tensor, index: Tensor) -> Tensor:
    """The rows [P, C] of the points that pixels show; index -1 is an appended row of zeros."""
    return torch.cat((values, values.new_zeros(1, values.shape[1])))[index]


def scatter(rows: Tensor, index: Tensor, points: int) -> Tensor:
    """Sums [points, C] of the `rows` of the pixels that show each point."""
    sums = rows.new_zeros(points + 1, rows.shape[1])
    return sums.index_put_((index.long(),), rows, accumulate=True)[:-1]

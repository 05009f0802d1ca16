"""Splatting in plain torch: among the points of a pixel, the minimum of one key after another."""

from __future__ import annotations

import torch
from torch import Tensor

from methods.steernerf.kernels.splat import Rule


def splat(pixels: Tensor, depth: Tensor, width: int, height: int, rule: Rule) -> Tensor:
    """See `methods.steernerf.kernels.splat.splat`."""
    u, v = pixels.unbind(dim=1)
    # Compared as floats, where comparisons with NaN are false; converting huge or non-finite
    # values to integers is undefined.
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    taken = inside & (depth > 0) & (depth < torch.inf)  # [N]
    # No indices of valid points, which would wait for a GPU: other points go to an extra bin.
    bin_ = height * width
    row, column = (torch.where(taken, x, 0).long() for x in (v, u))  # not negative: this is floor
    pixel = torch.where(taken, row * width + column, bin_)
    if rule == "nearest":
        for key in (depth, u, v):
            key = torch.where(taken, key, torch.inf)
            least = key.new_full((bin_ + 1,), torch.inf)
            least.scatter_reduce_(0, pixel, key, "amin")
            taken &= key == least[pixel]
            pixel = torch.where(taken, pixel, bin_)
    index = torch.full((bin_ + 1,), -1, dtype=torch.int32, device=pixels.device)
    point = torch.arange(len(depth), dtype=torch.int32, device=pixels.device)
    first_or_last = "amin" if rule == "nearest" else "amax"
    index.scatter_reduce_(0, pixel, point, first_or_last, include_self=False)
    return index[:bin_].view(height, width)


def gather(values: Tensor, index: Tensor) -> Tensor:
    """See `methods.steernerf.kernels.splat.gather`."""
    # Index -1 is the appended row of zeros.
    return torch.cat((values, values.new_zeros(1, values.shape[1])))[index]

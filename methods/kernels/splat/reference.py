"""Splatting in plain torch: among the points of a pixel, the least of one key after another."""

from __future__ import annotations

import torch
from torch import Tensor

from methods.kernels.splat import Rule


def splat(pixels: Tensor, depth: Tensor, width: int, height: int, rule: Rule) -> Tensor:
    """See `methods.kernels.splat.splat`."""
    u, v = pixels.unbind(dim=1)
    # Compared as floats, where every comparison with nan is false: as integers, what is huge or
    # not finite has no defined value.
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    point = (inside & (depth > 0) & (depth < torch.inf)).nonzero()[:, 0]  # [M]
    pixel = v[point].long() * width + u[point].long()  # not negative: cut off is floor
    if rule == "nearest":
        for key in (depth, u, v):
            least = key.new_full((height * width,), torch.inf)
            least.scatter_reduce_(0, pixel, key[point], "amin")
            tied = key[point] == least[pixel]
            point, pixel = point[tied], pixel[tied]
    index = torch.full((height * width,), -1, dtype=torch.int32, device=pixels.device)
    first_or_last = "amin" if rule == "nearest" else "amax"
    index.scatter_reduce_(0, pixel, point.int(), first_or_last, include_self=False)
    return index.view(height, width)


def gather(values: Tensor, index: Tensor) -> Tensor:
    """See `methods.kernels.splat.gather`."""
    # -1 is the last row.
    return torch.cat((values, values.new_zeros(1, values.shape[1])))[index]

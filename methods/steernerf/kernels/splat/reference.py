"""Splatting in plain torch."""

import torch
from torch import Tensor


def splat(pixels: Tensor, depth: Tensor, width: int, height: int, last: Tensor) -> Tensor:
    """Write the number of the last point in each pixel into `last` [H W + 1], -1; return the pixel
    in which each point lands, [N] int64, H W for none. What `last` has there has no meaning."""
    u, v = pixels.unbind(dim=1)
    # Compared as floats, where comparisons with NaN are false; converting huge or non-finite
    # values to integers is undefined.
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    taken = inside & (depth > 0) & (depth < torch.inf)  # [N]
    # The point is rounded to a pixel; the conversion is floor, as coordinates are not negative.
    row, column = (torch.where(taken, x, 0).long() for x in (v, u))
    landed = torch.where(taken, row * width + column, width * height)
    number = torch.arange(len(depth), dtype=torch.int32, device=pixels.device)
    last.scatter_reduce_(0, landed, number, "amax")
    return landed

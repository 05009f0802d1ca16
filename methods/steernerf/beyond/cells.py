"""Cells: the s x s pixels of a picture that a low-resolution pixel stands for.

Only those near matter are drawn. N cells are given by their number, counted row by row; their
pixels stand beside each other, [N, s^2, ...], row by row, too.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

REACH = 1
"""Cells around matter that are still drawn: what is further from all that was seen is empty."""


def cells_near(seen: Tensor) -> Tensor:
    """Which cells lie within `REACH` of those that are `seen`, [h, w] bool."""
    near = seen.clone()
    for axis in (0, 1):
        line = near.clone()
        for far in range(1, REACH + 1):
            rest = line.shape[axis] - far
            near.narrow(axis, far, rest).logical_or_(line.narrow(axis, 0, rest))
            near.narrow(axis, 0, rest).logical_or_(line.narrow(axis, far, rest))
    return near


def largest_in_cell(image: Tensor, scale: int) -> Tensor:
    """[h, w]: of `image` [h s, w s] the largest pixel of each cell."""
    height, width = image.shape
    cells = image.view(height // scale, scale, width // scale, scale)
    return cells.amax(dim=1).amax(dim=2)  # four times as fast as both at once


def centres(cells: Tensor, width: int, scale: int) -> Tensor:
    """(u, v) of all pixels of `cells`, [N, s^2, 2], where a row has `width` cells."""
    sub = torch.arange(scale**2, device=cells.device)
    u = (cells % width)[:, None] * scale + sub % scale
    v = (cells // width)[:, None] * scale + sub // scale
    return torch.stack((u, v), dim=-1) + 0.5


def pixels_of(image: Tensor, cells: Tensor, scale: int) -> Tensor:
    """Of `image` [h s, w s, ...] the pixels of `cells`: [N, s^2, ...]."""
    width = image.shape[1] // scale
    return _blocks(image, scale)[cells // width, cells % width].flatten(1, 2)


def put_pixels(image: Tensor, cells: Tensor, scale: int, pixels: Tensor) -> None:
    """Replace, in place, the pixels of `cells` in `image` [h s, w s, ...] by `pixels`
    [N, s^2, ...]."""
    width = image.shape[1] // scale
    _blocks(image, scale)[cells // width, cells % width] = pixels.unflatten(1, (scale, scale))


def _blocks(image: Tensor, scale: int) -> Tensor:
    """`image` [h s, w s, ...] seen as [h, w, s, s, ...]; nothing is copied."""
    rows, columns = (side // scale for side in image.shape[:2])
    return image.unflatten(0, (rows, scale)).unflatten(2, (columns, scale)).transpose(1, 2)


def paint(
    cells: Sequence[Tensor], size: torch.Size, scale: int, pixels: Tensor, background: Tensor
) -> Tensor:
    """Pictures [B, h s, w s, C], `background` [C] outside of the `cells` of each, whose `pixels`
    [N, s^2, C] follow each other.

    Args:
        size: h, w.
    """
    height, width = size
    canvas = background.repeat(len(cells) * height * scale, width * scale, 1)
    # One below the other, they are a single picture.
    put_pixels(canvas, number(cells, size), scale, pixels)
    return canvas.view(len(cells), height * scale, width * scale, -1)


def number(cells: Sequence[Tensor], size: torch.Size) -> Tensor:
    """The `cells` of pictures of `size` h, w that lie one below the other, counted as of one."""
    height, width = size
    return torch.cat([some + picture * height * width for picture, some in enumerate(cells)])

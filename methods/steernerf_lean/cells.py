"""Cells: the s x s pixels of a picture that one low-resolution pixel covers. Cells have row-major
indices [N], their pixels are [N, s^2, ...], also row by row."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional


def cells_near(seen: Tensor) -> Tensor:
    """Which cells are `seen` or touch one that is: both [h, w] bool. Others are not drawn."""
    return functional.max_pool2d(seen[None].float(), 3, stride=1, padding=1)[0] > 0


def centres(cells: Tensor, width: int, scale: int) -> Tensor:
    """Centres (u, v) of all pixels of `cells`, [N, s^2, 2]; a row has `width` cells."""
    sub = torch.arange(scale**2, device=cells.device)
    u = (cells % width)[:, None] * scale + sub % scale
    v = (cells // width)[:, None] * scale + sub // scale
    return torch.stack((u, v), dim=-1) + 0.5


def pixels_of(image: Tensor, cells: Tensor, scale: int) -> Tensor:
    """The pixels of `cells` in `image` [h s, w s, ...]: [N, s^2, ...]."""
    width = image.shape[1] // scale
    return _blocks(image, scale)[cells // width, cells % width].flatten(1, 2)


def put_pixels(image: Tensor, cells: Tensor, scale: int, pixels: Tensor) -> None:
    """Write `pixels` [N, s^2, ...] to the `cells` of `image` [h s, w s, ...], in place."""
    width = image.shape[1] // scale
    _blocks(image, scale)[cells // width, cells % width] = pixels.unflatten(1, (scale, scale))


def _blocks(image: Tensor, scale: int) -> Tensor:
    """`image` [h s, w s, ...] seen as [h, w, s, s, ...]; nothing is copied."""
    rows, columns = (side // scale for side in image.shape[:2])
    return image.unflatten(0, (rows, scale)).unflatten(2, (columns, scale)).transpose(1, 2)


def paint(
    cells: Sequence[Tensor], size: torch.Size, scale: int, pixels: Tensor, background: Tensor
) -> Tensor:
    """Draw pictures [B, h s, w s, C] of `pixels` [N, s^2, C], which belong to the `cells` of one
    picture after the other, on `background` [C]; `size` is h, w."""
    height, width = size
    row = background.repeat(width * scale)  # whole rows: three numbers at a time are slow
    canvas = row.repeat(len(cells) * height * scale, 1).unflatten(1, (width * scale, -1))
    # Stacked vertically, they are a single picture.
    put_pixels(canvas, number(cells, size), scale, pixels)
    return canvas.view(len(cells), height * scale, width * scale, -1)


def number(cells: Sequence[Tensor], size: torch.Size) -> Tensor:
    """Indices of the `cells` of several pictures of `size` h, w, stacked vertically into one."""
    height, width = size
    return torch.cat([some + picture * height * width for picture, some in enumerate(cells)])

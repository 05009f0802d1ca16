"""Backward warping in plain torch, any dtype and device."""

from __future__ import annotations

import torch
from torch import Tensor

from bench.cameras import within
from methods.steernerf_lean.kernels.warp import TOLERANCE


def enlarge(depth: Tensor, cells: Tensor, scale: int) -> Tensor:
    """See `methods.steernerf_lean.kernels.warp.enlarge`."""
    v, u = (place.to(depth) for place in _pixels(cells, depth.shape[1], scale))
    rows, columns = v / scale - 0.5, u / scale - 0.5
    corners = []
    for down in (0, 1):
        for right in (0, 1):
            row, column = rows.floor() + down, columns.floor() + right
            weight = (1 - (rows - row).abs()) * (1 - (columns - column).abs())
            row = row.clamp(0, depth.shape[0] - 1).long()
            column = column.clamp(0, depth.shape[1] - 1).long()
            corners.append((depth[row, column], weight))
    weight = torch.stack([weight for _, weight in corners])
    z = torch.stack([z for z, _ in corners])
    z = torch.where(z.isfinite() & (weight > 0), z, torch.inf)
    weight = weight * (z <= z.amin(dim=0) + TOLERANCE) * z.isfinite()
    total = weight.sum(dim=0)
    mean = (weight * torch.where(z.isfinite(), z, 0)).sum(dim=0) / torch.where(total > 0, total, 1)
    return torch.where(total > 0, mean, torch.inf)


def warp(
    picture: Tensor,
    depth: Tensor,
    cells: Tensor,
    width: int,
    scale: int,
    projection: tuple[Tensor, Tensor],
) -> tuple[Tensor, Tensor]:
    """See `methods.steernerf_lean.kernels.warp.warp`."""
    matrix, offset, z = (x.to(picture) for x in (*projection, depth))
    v, u = (place.to(picture) for place in _pixels(cells, width, scale))
    known = (z > 0) & (z < torch.inf)
    pixel = torch.stack((u, v, torch.ones_like(u)), dim=-1)
    at = torch.where(known, z, 1)[..., None] * (pixel @ matrix.T) + offset  # [N, s^2, 3]
    known &= at[..., 2] > 0
    position = at[..., :2] / torch.where(known, at[..., 2], 1)[..., None]
    known &= within(position, picture.shape[1], picture.shape[0])
    values = _look_up(picture, torch.where(known[..., None], position, 0)) * known[..., None]
    return values, known.to(values)


def _pixels(cells: Tensor, width: int, scale: int) -> tuple[Tensor, Tensor]:
    """Centres (v, u), [N, s^2] each, of the pixels of `cells`; a row has `width` cells."""
    sub = torch.arange(scale**2, device=cells.device)
    row, column = (cells // width)[:, None], (cells % width)[:, None]
    return row * scale + sub // scale + 0.5, column * scale + sub % scale + 0.5


def _look_up(picture: Tensor, position: Tensor) -> Tensor:
    """Bilinear values at continuous `position` [..., 2], with a repeated border."""
    x, y = (position - 0.5).unbind(dim=-1)
    total = torch.zeros(())
    for down in (0, 1):
        for right in (0, 1):
            row, column = y.floor() + down, x.floor() + right
            weight = (1 - (y - row).abs()) * (1 - (x - column).abs())
            row = row.clamp(0, picture.shape[0] - 1).long()
            column = column.clamp(0, picture.shape[1] - 1).long()
            total = total + weight[..., None] * picture[row, column]
    return total

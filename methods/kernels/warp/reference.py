"""Backward warping in plain torch, any dtype and device."""

from __future__ import annotations

import torch
from torch import Tensor

from methods.kernels.warp import TOLERANCE


def warp(
    picture: Tensor,
    depth: Tensor,
    matrix: Tensor,
    offset: Tensor,
    scale: int,
    phase: tuple[float, float],
) -> tuple[Tensor, Tensor]:
    """See `methods.kernels.warp.warp`."""
    height, width = depth.shape
    matrix, offset = matrix.to(picture), offset.to(picture)
    v = torch.arange(height * scale, device=depth.device, dtype=picture.dtype) + 0.5
    u = torch.arange(width * scale, device=depth.device, dtype=picture.dtype) + 0.5
    z = _upsample(depth.to(picture.dtype), v, u, scale, phase)  # [H, W], inf where there is none
    known = z.isfinite()
    grid = torch.stack((*torch.meshgrid(u, v, indexing="xy"), torch.ones_like(z)), dim=-1)
    at = torch.where(known, z, 1)[..., None] * (grid @ matrix.T) + offset  # [H, W, 3]
    known &= at[..., 2] > 0
    position = at[..., :2] / torch.where(known, at[..., 2], 1)[..., None]
    size = position.new_tensor((picture.shape[1], picture.shape[0]))
    known &= ((position >= 0) & (position < size)).all(dim=-1)
    values = _look_up(picture, torch.where(known[..., None], position, 0)) * known[..., None]
    return _blocks(values, scale), _blocks(known[..., None].to(values), scale).squeeze(-1)


def enlarge(depth: Tensor, scale: int, phase: tuple[float, float]) -> Tensor:
    """See `methods.kernels.warp.enlarge`."""
    height, width = depth.shape
    v = torch.arange(height * scale, device=depth.device, dtype=depth.dtype) + 0.5
    u = torch.arange(width * scale, device=depth.device, dtype=depth.dtype) + 0.5
    return _blocks(_upsample(depth, v, u, scale, phase)[..., None], scale).squeeze(-1)


def _upsample(
    depth: Tensor, v: Tensor, u: Tensor, scale: int, phase: tuple[float, float]
) -> Tensor:
    """Depth at the full-resolution rows `v` and columns `u`; see the module's words."""
    rows, columns = (v - phase[1]) / scale - 0.5, (u - phase[0]) / scale - 0.5
    corners = []
    for down in (0, 1):
        for right in (0, 1):
            row, column = rows.floor() + down, columns.floor() + right
            weight = (1 - (rows - row).abs())[:, None] * (1 - (columns - column).abs())
            row = row.clamp(0, depth.shape[0] - 1).long()
            column = column.clamp(0, depth.shape[1] - 1).long()
            corners.append((depth[row][:, column], weight))
    weight = torch.stack([weight for _, weight in corners])
    z = torch.stack([z for z, _ in corners])
    z = torch.where(z.isfinite() & (weight > 0), z, torch.inf)
    weight = weight * (z <= z.amin(dim=0) + TOLERANCE) * z.isfinite()
    total = weight.sum(dim=0)
    mean = (weight * torch.where(z.isfinite(), z, 0)).sum(dim=0) / torch.where(total > 0, total, 1)
    return torch.where(total > 0, mean, torch.inf)


def _look_up(picture: Tensor, position: Tensor) -> Tensor:
    """Bilinear values at continuous `position` [..., 2], the border repeated."""
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


def _blocks(image: Tensor, scale: int) -> Tensor:
    """[h s, w s, C] to [h, w, s^2, C]."""
    height, width, channels = image.shape
    blocks = image.view(height // scale, scale, width // scale, scale, channels)
    return blocks.transpose(1, 2).reshape(height // scale, width // scale, scale**2, channels)

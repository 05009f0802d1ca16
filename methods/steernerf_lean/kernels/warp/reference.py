"""Backward warping in plain torch, any dtype and device."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from bench.cameras import within
from methods.steernerf_lean.cells import centres
from methods.steernerf_lean.kernels.warp import TOLERANCE


def enlarge(depth: Tensor, cells: Tensor, scale: int) -> Tensor:
    """The mean depth of each pixel over those of its four samples that are in front."""
    u, v = centres(cells, depth.shape[1], scale).to(depth).unbind(dim=-1)
    corners = list(_corners(depth, v / scale, u / scale))
    z, weight = (torch.stack(parts) for parts in zip(*corners, strict=True))
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
    """Project the pixels of `cells`, of which a row has `width`, and look them up."""
    matrix, offset, z = (x.to(picture) for x in (*projection, depth))
    uv = centres(cells, width, scale).to(picture)
    known = (z > 0) & (z < torch.inf)
    pixel = torch.cat((uv, torch.ones_like(uv[..., :1])), dim=-1)
    at = torch.where(known, z, 1)[..., None] * (pixel @ matrix.T) + offset  # [N, s^2, 3]
    known &= at[..., 2] > 0
    position = at[..., :2] / torch.where(known, at[..., 2], 1)[..., None]
    known &= within(position, picture.shape[1], picture.shape[0])
    x, y = torch.where(known[..., None], position, 0).unbind(dim=-1)
    values = sum(weight[..., None] * value for value, weight in _corners(picture, y, x))
    return values * known[..., None], known.to(values)


def _corners(image: Tensor, y: Tensor, x: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
    """Values and bilinear weights of the four pixels of `image` [h, w, ...] around the place (y,
    x), with a repeated border."""
    y, x = y - 0.5, x - 0.5
    for down in (0, 1):
        for right in (0, 1):
            row, column = y.floor() + down, x.floor() + right
            weight = (1 - (y - row).abs()) * (1 - (x - column).abs())
            row = row.clamp(0, image.shape[0] - 1).long()
            column = column.clamp(0, image.shape[1] - 1).long()
            yield image[row, column], weight

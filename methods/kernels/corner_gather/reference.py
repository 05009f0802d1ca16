"""Corner features in plain torch, differentiable in table and weights."""

from __future__ import annotations

import torch
from torch import Tensor

from bench.types import Rays
from methods.kernels.voxel_walk import Crossings, Voxels


def gather(
    table: Tensor,
    corners: Tensor,
    voxel: Tensor,
    weights: Tensor,
    *,
    grad_buffer: Tensor | None = None,
) -> Tensor:
    """See `methods.kernels.corner_gather.gather`."""
    if grad_buffer is not None:
        table = table.detach().requires_grad_()
        table.register_hook(grad_buffer.add_)
    values = table[corners[voxel.long()].long()].to(weights.dtype)  # [S, 8, F]
    return (weights[..., None] * values).sum(dim=1)


def trilinear(local: Tensor) -> Tensor:
    """See `methods.kernels.corner_gather.trilinear`."""
    corner = torch.arange(8, device=local.device)
    bits = corner[:, None] >> torch.arange(3, device=local.device) & 1  # [8, 3]
    place = local[:, None]  # [S, 1, 3]
    return torch.where(bits.bool(), place, 1 - place).prod(dim=-1)


def integral(entry: Tensor, leave: Tensor) -> Tensor:
    """See `methods.kernels.corner_gather.integral`.

    A weight is a cubic along the segment, for which Simpson's rule is exact.
    """
    middle = trilinear((entry + leave) / 2)
    return (trilinear(entry) + 4 * middle + trilinear(leave)) / 6


@torch.no_grad()
def integral_along(rays: Rays, crossings: Crossings, voxels: Voxels) -> Tensor:
    """See `methods.kernels.corner_gather.integral_along`."""
    ray = crossings.ray.long()
    origins, directions = rays.origins[ray], rays.directions[ray]
    corner = voxels.coordinates[crossings.voxel.long()]
    ends = (
        # Clamped, because rounding may lead out of the voxel.
        ((origins + t[:, None] * directions) * voxels.resolution - corner).clamp(0, 1)
        for t in (crossings.near, crossings.far)
    )
    return integral(*ends)

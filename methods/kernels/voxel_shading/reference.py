"""Colours and pixels of voxels, put together from the operations that they consist of."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import normalize

from bench.types import Rays
from methods.kernels.composite import Pixels, composite, visible_counts, weights
from methods.kernels.spherical import shade
from methods.kernels.voxel_shading import Light
from methods.kernels.voxel_walk import Voxels, walk


def shade_voxels(
    harmonics: Tensor, voxel: Tensor, ray: Tensor, directions: Tensor, grad_buffer: Tensor | None
) -> Tensor:
    """See `methods.kernels.voxel_shading.shade_voxels`."""
    if grad_buffer is not None:
        harmonics = harmonics.detach().requires_grad_()
        harmonics.register_hook(grad_buffer.add_)
    towards = directions[ray.long()]
    return shade(harmonics[voxel.long()], towards, backend="reference").sigmoid()


@torch.no_grad()
def render_voxels(
    rays: Rays, voxels: Voxels, light: Light, stop: float, faint: float
) -> tuple[Pixels, Tensor, Tensor]:
    """See `methods.kernels.voxel_shading.render_voxels`."""
    crossings = walk(rays, voxels, backend="reference")
    sigma = light.density[crossings.voxel.long()]
    crossed = visible_counts(sigma, crossings, stop=stop, backend="reference")
    weight = weights(sigma, crossings, stop=stop, backend="reference")
    seen = weight > faint
    values = sigma.new_zeros(len(sigma), 3)
    values[seen] = shade_voxels(
        light.harmonics,
        crossings.voxel[seen],
        crossings.ray[seen],
        normalize(rays.directions, dim=1),
        None,
    )
    pixels = composite(sigma, values, crossings, stop=stop, backend="reference")
    shaded = torch.zeros(len(rays.origins), dtype=torch.int32, device=sigma.device)
    shaded.index_add_(0, crossings.ray.long(), seen.int())
    return pixels, crossed.int(), shaded

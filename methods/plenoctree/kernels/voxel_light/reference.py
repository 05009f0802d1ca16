"""Voxels in plain torch."""

import torch
from torch import Tensor
from torch.nn.functional import normalize

from bench.types import Rays
from methods.kernels.composite import composite, visibility
from methods.kernels.shade import shade
from methods.kernels.types import Pixels
from methods.kernels.voxel_walk import Voxels, walk
from methods.plenoctree.kernels.voxel_light import Light


@torch.no_grad()
def render_voxels(
    rays: Rays, voxels: Voxels, light: Light, stop: float, faint: float
) -> tuple[Pixels, Tensor, Tensor]:
    crossings = walk(rays, voxels, backend="reference")
    sigma = light.density[crossings.voxel.long()]
    weight, crossed, _ = visibility(sigma, crossings, stop=stop, backend="reference")
    shown = weight > faint
    seen = shown.nonzero().squeeze(1)
    values = sigma.new_zeros(len(sigma), 3)
    towards = normalize(rays.directions, dim=1)[crossings.ray[seen].long()]
    coefficients = light.harmonics[crossings.voxel[seen].long()]
    values[seen] = shade(coefficients, towards, backend="reference").sigmoid()
    pixels = composite(sigma, values, crossings, stop=stop, backend="reference")
    shaded = torch.zeros(len(rays.origins), dtype=torch.int32, device=sigma.device)
    shaded.index_add_(0, crossings.ray.long(), shown.int())
    return pixels, crossed.int(), shaded


def shade_voxels(
    harmonics: Tensor, voxel: Tensor, ray: Tensor, directions: Tensor, grad_buffer: Tensor | None
) -> Tensor:
    if grad_buffer is not None:
        harmonics.register_hook(grad_buffer.add_)
    return shade(harmonics[voxel.long()], directions[ray.long()], backend="reference").sigmoid()

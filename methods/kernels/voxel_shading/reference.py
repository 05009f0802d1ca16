"""Colours of voxels in plain torch."""

from __future__ import annotations

from torch import Tensor

from methods.kernels.spherical import shade


def shade_voxels(
    harmonics: Tensor, voxel: Tensor, ray: Tensor, directions: Tensor, grad_buffer: Tensor | None
) -> Tensor:
    """See `methods.kernels.voxel_shading.shade_voxels`."""
    if grad_buffer is not None:
        harmonics = harmonics.detach().requires_grad_()
        harmonics.register_hook(grad_buffer.add_)
    towards = directions[ray.long()]
    return shade(harmonics[voxel.long()], towards, backend="reference").sigmoid()

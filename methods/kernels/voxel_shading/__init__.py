"""Differentiable colours of voxels, each with one set of spherical harmonics, for training.

A voxel shows sigmoid(sum_k c_k Y_k(d)) in direction d (Yu et al. 2021, Eq. 3).
"""

from __future__ import annotations

from torch import Tensor

from bench.types import check_shape
from methods.kernels.dispatch import implementation
from methods.kernels.spherical import SIZES


def shade_voxels(
    harmonics: Tensor,
    voxel: Tensor,
    ray: Tensor,
    directions: Tensor,
    *,
    grad_buffer: Tensor | None = None,
    backend: str = "auto",
) -> Tensor:
    """Colours [S, 3] of S voxels in the directions of their rays.

    Differentiable in `harmonics`.

    Args:
        harmonics: [V, C, 3] coefficients of the first C harmonics in the order of `spherical`;
            C is 1, 4, 9 or 16.
        voxel: [S] int32 rows of `harmonics`; rows may repeat.
        ray: [S] int32 rows of `directions`.
        directions: [R, 3] unit vectors.
        grad_buffer: [V, C, 3]; if given, the gradient of `harmonics` is added to it in place and
            hidden from autograd.

    Raises:
        ValueError: wrong shapes; backend "cpu": not float32.
    """
    check_shape("harmonics", harmonics, None, None, 3)
    if harmonics.shape[1] not in SIZES:
        raise ValueError(
            f"harmonics: expected one of {SIZES} coefficients a colour, got {list(harmonics.shape)}"
        )
    check_shape("voxel", voxel, None)
    check_shape("ray", ray, len(voxel))
    check_shape("directions", directions, None, 3)
    if grad_buffer is not None:
        check_shape("grad_buffer", grad_buffer, *harmonics.shape)
        if not harmonics.requires_grad:
            harmonics = harmonics.detach().requires_grad_()  # otherwise there is no backward pass
    kernel = implementation(__name__, backend, harmonics.device)
    colours: Tensor = kernel.shade_voxels(harmonics, voxel, ray, directions, grad_buffer)
    return colours

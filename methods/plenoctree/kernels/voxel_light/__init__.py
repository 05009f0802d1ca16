"""Colours of voxels that hold a density and spherical harmonics: pixels, and samples to train on.

A voxel has the opacity 1 - exp(-sigma delta) over a length delta, and shows sigmoid(sum_k c_k
Y_k(d)) in direction d (Yu et al. 2021, Eq. 1 to 3).
"""

from dataclasses import dataclass

from torch import Tensor

from bench.types import Rays, check_shape
from methods.kernels.composite import STOP
from methods.kernels.dispatch import implementation
from methods.kernels.settings import TRANSMITTANCE
from methods.kernels.shade import check_harmonics
from methods.kernels.types import Pixels, check_rays
from methods.kernels.voxel_walk import Voxels


@dataclass(frozen=True)
class Light:
    """The contents of V voxels."""

    density: Tensor  # [V] 1 / scene unit, not negative
    harmonics: Tensor  # [V, C, 3] coefficients of the first C of `spherical`: 1, 4, 9 or 16


def render_voxels(
    rays: Rays,
    voxels: Voxels,
    light: Light,
    *,
    stop: float = STOP,
    faint: float = 0.0,
    backend: str = "auto",
) -> tuple[Pixels, Tensor, Tensor]:
    """Render R `rays`, which end at the transmittance `stop`, without a background; voxels with at
    most the weight `faint` count for opacity but are not shaded. Not differentiable. Returns the
    pixels and, for each ray, the numbers of crossed and of shaded voxels: [R] int32."""
    TRANSMITTANCE.check("stop", stop)
    check_rays(rays)
    check_shape("density", light.density, len(voxels))
    check_harmonics("harmonics", light.harmonics, len(voxels))
    kernel = implementation(__name__, backend, rays.origins.device)
    return kernel.render_voxels(rays, voxels, light, stop, faint)


def shade_voxels(
    harmonics: Tensor,
    voxel: Tensor,
    ray: Tensor,
    directions: Tensor,
    *,
    grad_buffer: Tensor | None = None,
    backend: str = "auto",
) -> Tensor:
    """Colours [S, 3] of some voxels, rows `voxel` [S] int32 of the `harmonics` [V, C, 3], in the
    direction of their `ray` [S] int32, a row of the unit vectors `directions` [R, 3].
    Differentiable in `harmonics`; if a `grad_buffer` of their shape is given, the gradient is added
    to it in place and hidden from autograd."""
    check_harmonics("harmonics", harmonics, None)
    check_shape("voxel", voxel, None)
    check_shape("ray", ray, len(voxel))
    check_shape("directions", directions, None, 3)
    if grad_buffer is not None:
        check_shape("grad_buffer", grad_buffer, *harmonics.shape)
        harmonics = harmonics.detach().requires_grad_()  # otherwise there may be no backward pass
    kernel = implementation(__name__, backend, harmonics.device)
    return kernel.shade_voxels(harmonics, voxel, ray, directions, grad_buffer)

"""Colours and pixels of voxels of one density and one set of spherical harmonics each.

A voxel shows sigmoid(sum_k c_k Y_k(d)) in direction d, and over a length delta it has the opacity
1 - exp(-sigma delta) (Yu et al. 2021, Eq. 1 to 3).
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from bench.types import Rays, check_shape
from methods.kernels.composite import STOP, Pixels, check_stop
from methods.kernels.dispatch import implementation
from methods.kernels.spherical import SIZES
from methods.kernels.voxel_walk import Voxels


@dataclass(frozen=True)
class Light:
    """What V voxels hold.

    Attributes:
        density: [V] 1 / scene unit, not negative.
        harmonics: [V, C, 3] coefficients of the first C spherical harmonics, C of 1, 4, 9 or 16.
    """

    density: Tensor
    harmonics: Tensor


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
        harmonics: [V, C, 3]; see `Light`.
        voxel: [S] int32 rows of `harmonics`; any number of times the same.
        ray: [S] int32 rows of `directions`.
        directions: [R, 3] unit vectors.
        grad_buffer: [V, C, 3]; when given, the gradient of `harmonics` is added to it in place, and
            autograd sees none.

    Raises:
        ValueError: wrong shapes; backend "cpu": not float32.
    """
    _check_harmonics(harmonics)
    check_shape("voxel", voxel, None)
    check_shape("ray", ray, len(voxel))
    check_shape("directions", directions, None, 3)
    if grad_buffer is not None:
        check_shape("grad_buffer", grad_buffer, *harmonics.shape)
    kernel = implementation("voxel_shading", backend, harmonics.device)
    colours: Tensor = kernel.shade_voxels(harmonics, voxel, ray, directions, grad_buffer)
    return colours


def render_voxels(
    rays: Rays,
    voxels: Voxels,
    light: Light,
    *,
    stop: float = STOP,
    faint: float = 0.0,
    backend: str = "auto",
) -> tuple[Pixels, Tensor, Tensor]:
    """The pixels of R `rays`, not composited on a background. Not differentiable.

    Also, for each ray, how many voxels it crossed and how many of them it shaded: [R] int32.

    Args:
        stop: transmittance at which a ray ends, less than 1.
        faint: weight up to which a voxel has an opacity but no colour.

    Raises:
        ValueError: wrong shapes, a stop outside [0, 1); backend "cpu": not float32.
    """
    check_stop(stop)
    check_shape("origins", rays.origins, None, 3)
    check_shape("directions", rays.directions, len(rays.origins), 3)
    check_shape("density", light.density, len(voxels))
    _check_harmonics(light.harmonics)
    check_shape("harmonics", light.harmonics, len(voxels), None, 3)
    kernel = implementation("voxel_shading", backend, rays.origins.device)
    found: tuple[Pixels, Tensor, Tensor] = kernel.render_voxels(rays, voxels, light, stop, faint)
    return found


def _check_harmonics(harmonics: Tensor) -> None:
    check_shape("harmonics", harmonics, None, None, 3)
    if harmonics.shape[1] not in SIZES:
        raise ValueError(
            f"harmonics: expected one of {SIZES} coefficients a colour, got {list(harmonics.shape)}"
        )

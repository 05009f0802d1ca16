"""Projection of Gaussians in plain torch, differentiated by autograd."""

import torch
from torch import Tensor

from bench.types import Camera
from methods.gaussians.kernels.projection import (
    BLUR,
    FRUSTUM,
    LEAST_ALPHA,
    NEAR,
    Ellipses,
    covariances,
)


def project_gaussians(
    means: Tensor, scales: Tensor, rotations: Tensor, opacities: Tensor, camera: Camera
) -> Ellipses:
    with torch.no_grad():
        centres, conics, depth, _ = _ellipses(means, scales, rotations, opacities, camera)
        shown = (depth > NEAR) & (opacities >= LEAST_ALPHA)
        shown &= conics.isfinite().all(dim=1) & centres.isfinite().all(dim=1)
    # Invisible Gaussians are replaced by harmless values, so that no gradient is NaN.
    axis = camera.c2w.to(means)
    given = (
        torch.where(shown[:, None], means, axis[:, 3] + axis[:, 2]),
        torch.where(shown[:, None], scales, 1),
        torch.where(shown[:, None], rotations, 1),
    )
    centres, conics, _, extents = _ellipses(*given, opacities, camera)
    found = (torch.where(shown[:, None], x, 0) for x in (centres, conics, extents.detach()))
    centres, conics, extents = found
    return Ellipses(centres, conics, depth, extents)


def _ellipses(
    means: Tensor, scales: Tensor, rotations: Tensor, opacities: Tensor, camera: Camera
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Centres, conics, depth and extents, without checks of visibility."""
    pose = camera.c2w.to(means)
    local = (means - pose[:, 3]) @ pose[:, :3]  # W (mean - c), row vectors
    x, y, z = local.unbind(dim=1)
    centres = torch.stack((camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy), dim=1)

    limit_x = FRUSTUM * 0.5 * camera.width / camera.fx
    limit_y = FRUSTUM * 0.5 * camera.height / camera.fy
    x, y = (z * (x / z).clamp(-limit_x, limit_x), z * (y / z).clamp(-limit_y, limit_y))
    zero = torch.zeros_like(z)
    rows = camera.fx / z, zero, -camera.fx * x / z**2, zero, camera.fy / z, -camera.fy * y / z**2
    jacobian = torch.stack(rows, dim=1).view(-1, 2, 3)
    slopes = jacobian @ pose[:, :3].T  # J W
    spread = slopes @ covariances(scales, rotations) @ slopes.transpose(1, 2)
    xx, xy, yy = spread[:, 0, 0] + BLUR, spread[:, 0, 1], spread[:, 1, 1] + BLUR
    area = xx * yy - xy**2
    conics = torch.stack((yy, -xy, xx), dim=1) / area[:, None]
    reach = 2 * (opacities.clamp(min=LEAST_ALPHA) / LEAST_ALPHA).log()
    return centres, conics, z, (reach[:, None] * torch.stack((xx, yy), dim=1)).sqrt()

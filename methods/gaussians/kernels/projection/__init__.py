"""Projects 3D Gaussians to ellipses (Zwicker et al. 2001, EWA splatting; Kerbl et al. 2023).

A Gaussian with rotation R and scales s has the covariance V = (R diag s) (R diag s)^T. Seen by a
camera with rotation W, its ellipse has the covariance V' = J W V W^T J^T + BLUR I, where J is the
derivative of the projection at its centre.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from bench.types import Camera, check_shape
from methods.kernels.dispatch import implementation

BLUR = 0.3
"""Added to the variance of every ellipse, in pixels^2: none is much narrower than a pixel."""

NEAR = 0.01  # minimum z-depth of a visible Gaussian, in scene units

FRUSTUM = 1.3
"""J is evaluated at most this many half pictures from the axis; farther out it is unbounded."""

LEAST_ALPHA = 1 / 255  # a Gaussian is cut off where its opacity is less


@dataclass(frozen=True)
class Ellipses:
    """N Gaussians projected to a picture.

    A conic is A, B, C of the squared distance A x^2 + 2 B x y + C y^2 from the centre, the inverse
    of V'. An extent is half the width and height of the box of all points where the opacity is at
    least `LEAST_ALPHA`; 0 for an invisible Gaussian.
    """

    centres: Tensor  # [N, 2] (u, v), pixels
    conics: Tensor  # [N, 3] pixels^-2
    depth: Tensor  # [N] z-depth of the centre
    extents: Tensor  # [N, 2] pixels


def project_gaussians(
    means: Tensor,
    scales: Tensor,
    rotations: Tensor,
    opacities: Tensor,
    camera: Camera,
    *,
    backend: str = "auto",
) -> Ellipses:
    """Project N Gaussians to ellipses: `means` [N, 3] and standard deviations along their axes,
    `scales` [N, 3], in scene units; `rotations` [N, 4], quaternions (w, x, y, z) of any non-zero
    length; `opacities` [N] at the centre.

    Centres and conics are differentiable in means, scales and rotations; for invisible Gaussians
    they are zeros without gradient. Depth and extents have no gradient.
    """
    count = len(means)
    check_shape("means", means, None, 3)
    check_shape("scales", scales, count, 3)
    check_shape("rotations", rotations, count, 4)
    check_shape("opacities", opacities, count)
    kernel = implementation(__name__, backend, means.device)
    return kernel.project_gaussians(means, scales, rotations, opacities.detach(), camera)


def covariances(scales: Tensor, rotations: Tensor) -> Tensor:
    """V [N, 3, 3] of N Gaussians."""
    w, x, y, z = torch.nn.functional.normalize(rotations, dim=1).unbind(dim=1)
    entries = (  # of R
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    )  # fmt: skip
    factors = torch.stack(entries, dim=1).view(-1, 3, 3) * scales[:, None]
    return factors @ factors.transpose(1, 2)

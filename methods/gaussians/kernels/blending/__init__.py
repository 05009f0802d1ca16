"""Blends ellipses of 3D Gaussians into a picture, front to back (Kerbl et al. 2023, Eq. 2 and 3).

alpha_i = min(LARGEST_ALPHA, o_i exp(-(A x^2 + 2 B x y + C y^2) / 2)), 0 below LEAST_ALPHA,
T_i = prod_{j<i} (1 - alpha_j),  w_i = T_i alpha_i,
values = sum w_i c_i,  depth_sum = sum w_i z_i,  alpha = sum w_i
at the centre of every pixel, with (x, y) relative to the centre of the ellipse, in depth order.
"""

from torch import Tensor

from bench.types import check_shape
from methods.gaussians.kernels.projection import Ellipses
from methods.kernels.composite import STOP
from methods.kernels.dispatch import implementation
from methods.kernels.types import Pixels

LARGEST_ALPHA = 0.99


def blend(
    ellipses: Ellipses,
    opacities: Tensor,
    colours: Tensor,
    width: int,
    height: int,
    *,
    stop: float = STOP,
    backend: str = "auto",
) -> Pixels:
    """Render the pixels of a width x height picture, row by row, without a background, of Gaussians
    with `opacities` [N] at their centres and `colours` [N, 3]. Behind a transmittance of at most
    `stop` they have no weight; those of equal depth are blended as they are given.

    Values and alpha are differentiable in centres, conics, opacities and colours.
    """
    count = len(opacities)
    check_shape("opacities", opacities, None)
    check_shape("colours", colours, count, 3)
    check_shape("centres", ellipses.centres, count, 2)
    check_shape("conics", ellipses.conics, count, 3)
    kernel = implementation(__name__, backend, opacities.device)
    return kernel.blend(ellipses, opacities, colours, width, height, stop)

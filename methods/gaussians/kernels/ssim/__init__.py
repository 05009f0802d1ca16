"""SSIM as a loss (Wang et al. 2004): 11 x 11 Gaussian window, sigma 1.5, K1 = 0.01, K2 = 0.03."""

import math

from torch import Tensor

from bench.types import check_shape
from methods.kernels.dispatch import implementation

REACH = 5  # pixels from the middle of the window to its border
_SHARES = [math.exp(-(i**2) / (2 * 1.5**2)) for i in range(-REACH, REACH + 1)]
WINDOW = tuple(share / sum(_SHARES) for share in _SHARES)
C1, C2 = 0.01**2, 0.03**2


def ssim(picture: Tensor, target: Tensor, *, backend: str = "auto") -> Tensor:
    """Mean structural similarity of two pictures [H, W, 3] in [0, 1]; a scalar.

    The mean is over all pixels and channels; beyond the border both pictures are black.
    Differentiable in `picture`. With backend="cpu" a `target` that needs a gradient is refused.
    """
    check_shape("picture", picture, None, None, 3)
    check_shape("target", target, *picture.shape)
    return implementation(__name__, backend, picture.device).ssim(picture, target)

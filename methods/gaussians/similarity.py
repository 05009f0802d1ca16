"""SSIM as a loss (Wang et al. 2004): 11 x 11 Gaussian window, sigma 1.5."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

SIDE, SIGMA = 11, 1.5
C1, C2 = 0.01**2, 0.03**2


def dissimilarity(picture: Tensor, target: Tensor) -> Tensor:
    """1 - SSIM of two pictures [H, W, 3] in [0, 1]; beyond the border both are black."""
    x, y = picture.movedim(-1, 0), target.movedim(-1, 0)
    mean_x, mean_y, xx, yy, xy = _blur(torch.cat((x, y, x * x, y * y, x * y))).split(3)
    variances = xx - mean_x**2 + yy - mean_y**2
    covariance = xy - mean_x * mean_y
    similarity = ((2 * mean_x * mean_y + C1) * (2 * covariance + C2)) / (
        (mean_x**2 + mean_y**2 + C1) * (variances + C2)
    )
    return 1 - similarity.mean()


def _blur(maps: Tensor) -> Tensor:
    """Each of [C, H, W] under the window, rows and columns in turn."""
    offsets = torch.arange(SIDE, device=maps.device, dtype=maps.dtype) - SIDE // 2
    window = torch.exp(-(offsets**2) / (2 * SIGMA**2))
    window = (window / window.sum()).view(1, 1, 1, SIDE)
    blurred = functional.conv2d(maps[:, None], window, padding=(0, SIDE // 2))
    return functional.conv2d(blurred, window.movedim(3, 2), padding=(SIDE // 2, 0))[:, 0]

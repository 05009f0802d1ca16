"""SSIM in plain torch: windows as convolutions."""

import torch
from torch import Tensor
from torch.nn import functional

from methods.gaussians.kernels.ssim import C1, C2, REACH, WINDOW


def ssim(picture: Tensor, target: Tensor) -> Tensor:
    x, y = picture.movedim(-1, 0), target.movedim(-1, 0)
    mean_x, mean_y, xx, yy, xy = _blur(torch.cat((x, y, x * x, y * y, x * y))).split(3)
    variances = xx - mean_x**2 + yy - mean_y**2
    covariance = xy - mean_x * mean_y
    similarity = ((2 * mean_x * mean_y + C1) * (2 * covariance + C2)) / (
        (mean_x**2 + mean_y**2 + C1) * (variances + C2)
    )
    return similarity.mean()


def _blur(maps: Tensor) -> Tensor:
    """Apply the window to each of [C, H, W], along rows and then along columns."""
    window = torch.tensor(WINDOW, dtype=maps.dtype).to(maps.device, non_blocking=True)
    blurred = functional.conv2d(maps[:, None], window.view(1, 1, 1, -1), padding=(0, REACH))
    return functional.conv2d(blurred, window.view(1, 1, -1, 1), padding=(REACH, 0))[:, 0]

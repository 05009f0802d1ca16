"""SSIM as a loss: that of scikit-image. The backends agree by its cases."""

import torch
from skimage.metrics import structural_similarity
from torch.nn import functional

from methods.gaussians.kernels.ssim import ssim
from tests.common import seeded


def pictures() -> tuple[torch.Tensor, torch.Tensor]:
    """Two pictures of noise in a black frame wider than the window: no border is in sight."""
    inner = torch.rand(2, 3, 20, 24, generator=seeded(0), dtype=torch.float64)
    one, other = functional.pad(inner, (11, 11, 11, 11)).movedim(1, -1)
    return one.contiguous(), other.contiguous()


def test_it_is_the_ssim_of_scikit_image():
    one, other = pictures()
    window = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    how = window | {"data_range": 1.0, "channel_axis": -1, "full": True}
    for second in (one, other):
        want = structural_similarity(one.numpy(), second.numpy(), **how)[1].mean()
        assert abs(ssim(one, second, backend="reference").item() - want) < 1e-12

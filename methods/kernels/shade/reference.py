"""Sums of harmonics in plain torch."""

from torch import Tensor

from methods.kernels.spherical import spherical_harmonics


def shade(coefficients: Tensor, directions: Tensor) -> Tensor:
    basis = spherical_harmonics(directions)[:, : coefficients.shape[1]]
    return (basis[:, :, None] * coefficients).sum(dim=1)

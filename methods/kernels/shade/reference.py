"""Harmonics and their sums in plain torch."""

from torch import Tensor

from methods.kernels.spherical import spherical_harmonics as harmonics


def shade(coefficients: Tensor, directions: Tensor) -> Tensor:
    basis = harmonics(directions)[:, : coefficients.shape[1]]
    return (basis[:, :, None] * coefficients).sum(dim=1)

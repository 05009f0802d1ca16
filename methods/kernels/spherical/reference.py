"""Spherical harmonics in plain torch."""

from __future__ import annotations

from math import pi, sqrt

import torch
from torch import Tensor


def spherical_harmonics(directions: Tensor) -> Tensor:
    x, y, z = directions.unbind(dim=-1)
    xx, yy, zz = x * x, y * y, z * z
    values = (
        torch.full_like(x, sqrt(1 / (4 * pi))),
        sqrt(3 / (4 * pi)) * y,
        sqrt(3 / (4 * pi)) * z,
        sqrt(3 / (4 * pi)) * x,
        sqrt(15 / (4 * pi)) * x * y,
        sqrt(15 / (4 * pi)) * y * z,
        sqrt(5 / (16 * pi)) * (2 * zz - xx - yy),
        sqrt(15 / (4 * pi)) * x * z,
        sqrt(15 / (16 * pi)) * (xx - yy),
        sqrt(35 / (32 * pi)) * y * (3 * xx - yy),
        sqrt(105 / (4 * pi)) * x * y * z,
        sqrt(21 / (32 * pi)) * y * (4 * zz - xx - yy),
        sqrt(7 / (16 * pi)) * z * (2 * zz - 3 * xx - 3 * yy),
        sqrt(21 / (32 * pi)) * x * (4 * zz - xx - yy),
        sqrt(105 / (16 * pi)) * z * (xx - yy),
        sqrt(35 / (32 * pi)) * x * (xx - 3 * yy),
    )
    return torch.stack(values, dim=-1)


def shade(coefficients: Tensor, directions: Tensor) -> Tensor:
    basis = spherical_harmonics(directions)[:, : coefficients.shape[1]]
    return (basis[:, :, None] * coefficients).sum(dim=1)

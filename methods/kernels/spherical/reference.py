"""Spherical harmonics in plain torch."""

import torch
from torch import Tensor

from methods.kernels.spherical import FACTORS

C00, C1, C2, C20, C22, C33, C3XYZ, C31, C30, C32 = FACTORS


def spherical_harmonics(directions: Tensor) -> Tensor:
    x, y, z = directions.unbind(dim=-1)
    xx, yy, zz = x * x, y * y, z * z
    values = (
        torch.full_like(x, C00),
        C1 * y,
        C1 * z,
        C1 * x,
        C2 * x * y,
        C2 * y * z,
        C20 * (2 * zz - xx - yy),
        C2 * x * z,
        C22 * (xx - yy),
        C33 * y * (3 * xx - yy),
        C3XYZ * x * y * z,
        C31 * y * (4 * zz - xx - yy),
        C30 * z * (2 * zz - 3 * xx - 3 * yy),
        C31 * x * (4 * zz - xx - yy),
        C32 * z * (xx - yy),
        C33 * x * (xx - 3 * yy),
    )
    return torch.stack(values, dim=-1)

"""Real spherical harmonics of view directions, degrees 0 to 3."""

import math

import torch
from torch import Tensor

from bench.types import check_shape

CHANNELS = 16
RATIOS = (1 / 4, 3 / 4, 15 / 4, 5 / 16, 15 / 16, 35 / 32, 105 / 4, 21 / 32, 7 / 16, 105 / 16)
FACTORS = [math.sqrt(ratio / math.pi) for ratio in RATIOS]
"""Factors of the polynomials, in the order of their first use by degree and order."""

C00, C1, C2, C20, C22, C33, C3XYZ, C31, C30, C32 = FACTORS


def spherical_harmonics(directions: Tensor) -> Tensor:
    """Values at unit `directions` [R, 3]: [R, 16], ordered (l, m) = (0,0) (1,-1) (1,0) ... (3,3).

    Orthonormal over the sphere, without the Condon-Shortley phase, as polynomials in x, y, z.
    """
    check_shape("directions", directions, None, 3)
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

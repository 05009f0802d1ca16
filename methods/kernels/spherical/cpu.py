"""Spherical harmonics with numba: one pass, 64 bytes written for 12 read."""

from __future__ import annotations

from math import pi, sqrt

import torch
from numba import njit, prange
from torch import Tensor

from methods.kernels.cpu import f32

C00 = f32(sqrt(1 / (4 * pi)))
C1 = f32(sqrt(3 / (4 * pi)))
C2 = f32(sqrt(15 / (4 * pi)))
C20 = f32(sqrt(5 / (16 * pi)))
C22 = f32(sqrt(15 / (16 * pi)))
C33 = f32(sqrt(35 / (32 * pi)))
C3XYZ = f32(sqrt(105 / (4 * pi)))
C31 = f32(sqrt(21 / (32 * pi)))
C30 = f32(sqrt(7 / (16 * pi)))
C32 = f32(sqrt(105 / (16 * pi)))


def spherical_harmonics(directions: Tensor) -> Tensor:
    """See `methods.kernels.spherical.spherical_harmonics`."""
    if directions.dtype != torch.float32 or directions.requires_grad:
        raise ValueError(
            "backend 'cpu' takes float32 directions without gradient: use backend='reference'"
        )
    values = torch.empty(len(directions), 16)
    _evaluate(directions.contiguous().numpy(), values.numpy())
    return values


@njit(cache=True, parallel=True)
def _evaluate(directions, out):
    for i in prange(len(directions)):
        x, y, z = directions[i, 0], directions[i, 1], directions[i, 2]
        xx, yy, zz = x * x, y * y, z * z
        out[i, 0] = C00
        out[i, 1], out[i, 2], out[i, 3] = C1 * y, C1 * z, C1 * x
        out[i, 4], out[i, 5], out[i, 7] = C2 * x * y, C2 * y * z, C2 * x * z
        out[i, 6] = C20 * (f32(2) * zz - xx - yy)
        out[i, 8] = C22 * (xx - yy)
        out[i, 9] = C33 * y * (f32(3) * xx - yy)
        out[i, 10] = C3XYZ * x * y * z
        out[i, 11] = C31 * y * (f32(4) * zz - xx - yy)
        out[i, 12] = C30 * z * (f32(2) * zz - f32(3) * xx - f32(3) * yy)
        out[i, 13] = C31 * x * (f32(4) * zz - xx - yy)
        out[i, 14] = C32 * z * (xx - yy)
        out[i, 15] = C33 * x * (xx - f32(3) * yy)

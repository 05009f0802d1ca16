"""Spherical harmonics with Triton.

The harmonics of a direction (12 bytes) take 64 bytes. They are written as rows, in memory order:
each lane computes all harmonics of its direction and keeps those of its columns, which is cheaper
than scattered writes.
"""

import torch
import triton
import triton.language as tl
from torch import Tensor

from methods.kernels.gpu import check_types, launch, vector
from methods.kernels.spherical import CHANNELS, FACTORS

BLOCK = 1024  # numbers that a program writes, 8 per lane

C00, C1, C2, C20, C22, C33, C3XYZ, C31, C30, C32 = map(tl.constexpr, FACTORS)


def spherical_harmonics(directions: Tensor) -> Tensor:
    check_types(torch.float32, directions=directions)
    if directions.requires_grad:
        raise ValueError("backend 'gpu' gives no gradient for directions: use backend='reference'")
    values = directions.new_empty(len(directions), CHANNELS)
    rows = BLOCK // CHANNELS
    grid = (triton.cdiv(len(values), rows),)
    launch(_evaluate, grid, directions.contiguous(), values, len(values), ROWS=rows, SIZE=CHANNELS)
    return values


@triton.jit
def _harmonics(x, y, z):
    xx, yy, zz = x * x, y * y, z * z
    return (
        tl.full(x.shape, C00, tl.float32),
        y * C1,
        z * C1,
        x * C1,
        x * C2 * y,
        y * C2 * z,
        (2 * zz - xx - yy) * C20,
        x * C2 * z,
        (xx - yy) * C22,
        y * C33 * (3 * xx - yy),
        x * C3XYZ * y * z,
        y * C31 * (4 * zz - xx - yy),
        z * C30 * (2 * zz - 3 * xx - 3 * yy),
        x * C31 * (4 * zz - xx - yy),
        z * C32 * (xx - yy),
        x * C33 * (xx - 3 * yy),
    )


@triton.jit
def _evaluate(directions, values, count, ROWS: tl.constexpr, SIZE: tl.constexpr):
    i = tl.program_id(0).to(tl.int64) * ROWS + tl.arange(0, ROWS)
    inside = i < count
    x, y, z = vector(directions, i, inside)
    harmonics = _harmonics(x, y, z)
    column = tl.arange(0, SIZE)
    rows = tl.zeros([ROWS, SIZE], tl.float32)
    for k in tl.static_range(SIZE):
        rows = tl.where(column[None, :] == k, harmonics[k][:, None], rows)
    place = values + i[:, None] * SIZE + column[None, :]
    tl.store(place, rows, mask=inside[:, None])

"""Spherical harmonics with Triton.

The harmonics of a direction (12 bytes) take 64 bytes. They are written as rows, in memory order:
each lane computes all harmonics of its direction and keeps those of its columns, which is cheaper
than scattered writes.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from methods.kernels.gpu import check_types, launch, vector
from methods.kernels.spherical import CHANNELS, FACTORS

BLOCK = 1024
"""Numbers that a program writes, 8 per lane."""

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
def _harmonic(x, y, z, k: tl.constexpr):
    """The k-th harmonic."""
    xx, yy, zz = x * x, y * y, z * z
    if k == 0:
        return tl.full(x.shape, C00, tl.float32)
    elif k == 1:
        return y * C1
    elif k == 2:
        return z * C1
    elif k == 3:
        return x * C1
    elif k == 4:
        return x * C2 * y
    elif k == 5:
        return y * C2 * z
    elif k == 6:
        return (2 * zz - xx - yy) * C20
    elif k == 7:
        return x * C2 * z
    elif k == 8:
        return (xx - yy) * C22
    elif k == 9:
        return y * C33 * (3 * xx - yy)
    elif k == 10:
        return x * C3XYZ * y * z
    elif k == 11:
        return y * C31 * (4 * zz - xx - yy)
    elif k == 12:
        return z * C30 * (2 * zz - 3 * xx - 3 * yy)
    elif k == 13:
        return x * C31 * (4 * zz - xx - yy)
    elif k == 14:
        return z * C32 * (xx - yy)
    else:
        return x * C33 * (xx - 3 * yy)


@triton.jit
def _rows(x, y, z, column, SIZE: tl.constexpr):
    """For each direction, the harmonic of each `column`; 0 from `SIZE` on."""
    rows = tl.zeros([x.shape[0], column.shape[0]], tl.float32)
    for k in tl.static_range(SIZE):
        rows = tl.where(column[None, :] == k, _harmonic(x, y, z, k)[:, None], rows)
    return rows


@triton.jit
def _evaluate(directions, values, count, ROWS: tl.constexpr, SIZE: tl.constexpr):
    i = tl.program_id(0).to(tl.int64) * ROWS + tl.arange(0, ROWS)
    inside = i < count
    x, y, z = vector(directions, i, inside)
    column = tl.arange(0, SIZE)
    place = values + i[:, None] * SIZE + column[None, :]
    tl.store(place, _rows(x, y, z, column, SIZE), mask=inside[:, None])

"""Spherical harmonics with numba: one pass, 64 bytes written for 12 read."""

import numpy as np
import torch
from numba import prange
from torch import Tensor

from methods.kernels.cpu import arrays, check_float32, f32, jit
from methods.kernels.spherical import FACTORS

BLOCK = 256  # directions at a time; their 16 harmonics stay in the first-level cache

ROWS = 19  # rows of a block: the harmonics, and x, y, z

C00, C1, C2, C20, C22, C33, C3XYZ, C31, C30, C32 = map(f32, FACTORS)


def spherical_harmonics(directions: Tensor) -> Tensor:
    check_directions(directions)
    values = torch.empty(len(directions), 16)
    _evaluate(*arrays(directions, values))
    return values


def check_directions(directions: Tensor) -> None:
    """Raise ValueError unless they are of float32, and ask for no gradient."""
    check_float32(directions)
    if directions.requires_grad:
        raise ValueError("backend 'cpu' gives no gradient for directions: use backend='reference'")


@jit(parallel=True)
def _evaluate(directions, out):
    count = len(directions)
    for chunk in prange((count + BLOCK - 1) // BLOCK):
        first, size = chunk * BLOCK, min(BLOCK, count - chunk * BLOCK)
        basis = harmonics(directions, first, size)
        for i in range(size):
            for k in range(16):
                out[first + i, k] = basis[k * BLOCK + i]


@jit()
def harmonics(directions, first, size):
    """A block with the harmonics of `size` directions, number k of direction i at k * `BLOCK` + i.

    The directions are copied into it first: in a loop over one array LLVM sees what it may
    vectorise.
    """
    block = np.empty(ROWS * BLOCK, np.float32)
    for d in range(3):
        for i in range(size):
            block[(16 + d) * BLOCK + i] = directions[first + i, d]
    for i in range(size):
        x, y, z = block[16 * BLOCK + i], block[17 * BLOCK + i], block[18 * BLOCK + i]
        xx, yy, zz = x * x, y * y, z * z
        block[i] = C00
        block[BLOCK + i] = C1 * y
        block[2 * BLOCK + i] = C1 * z
        block[3 * BLOCK + i] = C1 * x
        block[4 * BLOCK + i] = C2 * x * y
        block[5 * BLOCK + i] = C2 * y * z
        block[7 * BLOCK + i] = C2 * x * z
        block[6 * BLOCK + i] = C20 * (f32(2) * zz - xx - yy)
        block[8 * BLOCK + i] = C22 * (xx - yy)
        block[9 * BLOCK + i] = C33 * y * (f32(3) * xx - yy)
        block[10 * BLOCK + i] = C3XYZ * x * y * z
        block[11 * BLOCK + i] = C31 * y * (f32(4) * zz - xx - yy)
        block[12 * BLOCK + i] = C30 * z * (f32(2) * zz - f32(3) * xx - f32(3) * yy)
        block[13 * BLOCK + i] = C31 * x * (f32(4) * zz - xx - yy)
        block[14 * BLOCK + i] = C32 * z * (xx - yy)
        block[15 * BLOCK + i] = C33 * x * (xx - f32(3) * yy)
    return block

"""Harmonics and their sums with numba, a block of directions at a time."""

import numpy as np
import torch
from numba import prange
from torch import Tensor

from methods.kernels.cpu import arrays, check_float32, f32, jit, u64
from methods.kernels.spherical import CHANNELS, FACTORS

BLOCK = 256  # directions at a time; their 16 harmonics stay in the first-level cache

ROWS = 19  # rows of a block: the harmonics, and x, y, z

C00, C1, C2, C20, C22, C33, C3XYZ, C31, C30, C32 = map(f32, FACTORS)

ZERO = f32(0)
ONE, TWO, THREE, NEXT = u64(1), u64(2), u64(3), u64(BLOCK)


def shade(coefficients: Tensor, directions: Tensor) -> Tensor:
    check_float32(coefficients)
    check_constant(directions)
    return _Shade.apply(coefficients, directions.contiguous())


def harmonics(directions: Tensor) -> Tensor:
    check_constant(directions)
    values = torch.empty(len(directions), CHANNELS)
    _evaluate(*arrays(directions.contiguous(), values))
    return values


def check_constant(directions: Tensor) -> None:
    """Raise ValueError unless they are of float32, and ask for no gradient."""
    check_float32(directions)
    if directions.requires_grad:
        raise ValueError("backend 'cpu' gives no gradient for directions: use backend='reference'")


class _Shade(torch.autograd.Function):
    @staticmethod
    def forward(ctx, coefficients, directions):
        colours, terms = torch.empty(len(directions), 3), coefficients.shape[1]
        _forward(*arrays(coefficients.flatten(), directions), terms, colours.numpy())
        ctx.save_for_backward(directions)
        ctx.shape = coefficients.shape
        return colours

    @staticmethod
    def backward(ctx, grad):
        (directions,) = ctx.saved_tensors
        grads = torch.empty(ctx.shape)
        _backward(*arrays(grad, directions), ctx.shape[1], grads.view(-1).numpy())
        return grads, None


@jit()
def _block(directions, first, size):
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


@jit(parallel=True)
def _evaluate(directions, out):
    count = len(directions)
    for chunk in prange((count + BLOCK - 1) // BLOCK):
        first, size = chunk * BLOCK, min(BLOCK, count - chunk * BLOCK)
        basis = _block(directions, first, size)
        for i in range(size):
            for k in range(16):
                out[first + i, k] = basis[k * BLOCK + i]


@jit(parallel=True)
def _forward(coefficients, directions, terms, colours):
    """`coefficients` are flat."""
    count = len(directions)
    for chunk in prange((count + BLOCK - 1) // BLOCK):
        first, size = chunk * BLOCK, min(BLOCK, count - chunk * BLOCK)
        basis = _block(directions, first, size)
        for i in range(size):
            at, of = u64((first + i) * terms * 3), u64(i)
            red, green, blue = ZERO, ZERO, ZERO
            for _ in range(terms):
                value = basis[of]
                red += value * coefficients[at]
                green += value * coefficients[at + ONE]
                blue += value * coefficients[at + TWO]
                at, of = at + THREE, of + NEXT
            colours[first + i, 0], colours[first + i, 1], colours[first + i, 2] = red, green, blue


@jit(parallel=True)
def _backward(grad, directions, terms, grads):
    """`grads` are flat."""
    count = len(directions)
    for chunk in prange((count + BLOCK - 1) // BLOCK):
        first, size = chunk * BLOCK, min(BLOCK, count - chunk * BLOCK)
        basis = _block(directions, first, size)
        for i in range(size):
            at, of = u64((first + i) * terms * 3), u64(i)
            red, green, blue = grad[first + i, 0], grad[first + i, 1], grad[first + i, 2]
            for _ in range(terms):
                value = basis[of]
                grads[at] = value * red
                grads[at + ONE] = value * green
                grads[at + TWO] = value * blue
                at, of = at + THREE, of + NEXT

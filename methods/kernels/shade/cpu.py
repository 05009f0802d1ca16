"""Sums of harmonics with numba, which are computed a block of directions at a time."""

import torch
from numba import prange
from torch import Tensor

from methods.kernels.cpu import arrays, check_float32, f32, jit, u64
from methods.kernels.spherical.cpu import BLOCK, check_directions, harmonics

ZERO = f32(0)
ONE, TWO, THREE, NEXT = u64(1), u64(2), u64(3), u64(BLOCK)


def shade(coefficients: Tensor, directions: Tensor) -> Tensor:
    check_directions(directions)
    check_float32(coefficients)
    return _Shade.apply(coefficients, directions.contiguous())


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


@jit(parallel=True)
def _forward(coefficients, directions, terms, colours):
    """`coefficients` are flat."""
    count = len(directions)
    for chunk in prange((count + BLOCK - 1) // BLOCK):
        first, size = chunk * BLOCK, min(BLOCK, count - chunk * BLOCK)
        basis = harmonics(directions, first, size)
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
        basis = harmonics(directions, first, size)
        for i in range(size):
            at, of = u64((first + i) * terms * 3), u64(i)
            red, green, blue = grad[first + i, 0], grad[first + i, 1], grad[first + i, 2]
            for _ in range(terms):
                value = basis[of]
                grads[at] = value * red
                grads[at + ONE] = value * green
                grads[at + TWO] = value * blue
                at, of = at + THREE, of + NEXT

"""Spherical harmonics with numba: one pass, 64 bytes written for 12 read."""

from __future__ import annotations

from math import pi, sqrt

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from methods.kernels.cpu import f32

CHUNK = 256  # directions
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


def shade(coefficients: Tensor, directions: Tensor) -> Tensor:
    """See `methods.kernels.spherical.shade`."""
    if not coefficients.dtype == directions.dtype == torch.float32 or directions.requires_grad:
        raise ValueError(
            "backend 'cpu' takes float32, and directions without gradient: use backend='reference'"
        )
    return _Shade.apply(coefficients, directions.contiguous())


class _Shade(torch.autograd.Function):
    @staticmethod
    def forward(ctx, coefficients, directions):
        colours = torch.empty(len(directions), 3)
        coefficients = coefficients.detach().contiguous()
        _shade(coefficients.numpy(), directions.numpy(), colours.numpy())
        ctx.save_for_backward(directions)
        ctx.shape = coefficients.shape
        return colours

    @staticmethod
    def backward(ctx, grad):
        (directions,) = ctx.saved_tensors
        grads = torch.empty(ctx.shape)
        _unshade(grad.contiguous().numpy(), directions.numpy(), grads.numpy())
        return grads, None


@njit(cache=True, parallel=True)
def _evaluate(directions, out):
    for i in prange(len(directions)):
        _harmonics(directions[i], out[i])


@njit(cache=True, parallel=True)
def _shade(coefficients, directions, colours):
    count, size, _ = coefficients.shape
    for chunk in prange((count + CHUNK - 1) // CHUNK):
        basis = np.empty(16, np.float32)
        for i in range(chunk * CHUNK, min(count, (chunk + 1) * CHUNK)):
            _harmonics(directions[i], basis)
            red, green, blue = f32(0), f32(0), f32(0)
            for k in range(size):
                red += basis[k] * coefficients[i, k, 0]
                green += basis[k] * coefficients[i, k, 1]
                blue += basis[k] * coefficients[i, k, 2]
            colours[i, 0], colours[i, 1], colours[i, 2] = red, green, blue


@njit(cache=True, parallel=True)
def _unshade(grad, directions, grads):
    count, size, _ = grads.shape
    for chunk in prange((count + CHUNK - 1) // CHUNK):
        basis = np.empty(16, np.float32)
        for i in range(chunk * CHUNK, min(count, (chunk + 1) * CHUNK)):
            _harmonics(directions[i], basis)
            for k in range(size):
                for channel in range(3):
                    grads[i, k, channel] = basis[k] * grad[i, channel]


@njit(cache=True)
def _harmonics(direction, out):
    x, y, z = direction[0], direction[1], direction[2]
    xx, yy, zz = x * x, y * y, z * z
    out[0] = C00
    out[1], out[2], out[3] = C1 * y, C1 * z, C1 * x
    out[4], out[5], out[7] = C2 * x * y, C2 * y * z, C2 * x * z
    out[6] = C20 * (f32(2) * zz - xx - yy)
    out[8] = C22 * (xx - yy)
    out[9] = C33 * y * (f32(3) * xx - yy)
    out[10] = C3XYZ * x * y * z
    out[11] = C31 * y * (f32(4) * zz - xx - yy)
    out[12] = C30 * z * (f32(2) * zz - f32(3) * xx - f32(3) * yy)
    out[13] = C31 * x * (f32(4) * zz - xx - yy)
    out[14] = C32 * z * (xx - yy)
    out[15] = C33 * x * (xx - f32(3) * yy)

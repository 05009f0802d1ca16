"""Corner features with numba: each table row is read whole, a few vectors of channels.

Forward: each thread handles a chunk of samples. Backward: each thread owns some table rows and goes
through all samples, so that no two threads add to the same number. This needs no atomics, and the
sums do not depend on the number of threads.
"""

import numpy as np
import torch
from numba import get_num_threads, prange, types
from numba.extending import overload
from torch import Tensor

from methods.kernels.cpu import FAST, arrays, check_float32, jit, u32

CHUNK = 256  # samples


def corner_gather(
    table: Tensor, corners: Tensor, voxel: Tensor, weights: Tensor, grad_buffer: Tensor | None
) -> Tensor:
    if weights.requires_grad:
        raise ValueError("backend 'cpu' gives no gradient for weights: use backend='reference'")
    check_float32(table, weights)
    if corners.dtype != torch.int32 or voxel.dtype != torch.int32:
        raise ValueError(
            f"backend 'cpu' takes int32 corners and voxels, got {corners.dtype}, {voxel.dtype}"
        )
    return _Gather.apply(table, corners, voxel, weights, grad_buffer)


class _Gather(torch.autograd.Function):
    @staticmethod
    def forward(ctx, table, corners, voxel, weights, grad_buffer):
        index = [x.contiguous() for x in (corners, voxel, weights)]
        ctx.save_for_backward(*index)
        ctx.shape, ctx.grad_buffer = table.shape, grad_buffer
        features = torch.empty(len(voxel), table.shape[1])
        _gather(*arrays(table, *index, features))
        return features

    @staticmethod
    def backward(ctx, grad):
        target = torch.zeros(ctx.shape) if ctx.grad_buffer is None else ctx.grad_buffer
        given = *arrays(grad, *ctx.saved_tensors), target.numpy()
        _scatter(*given, 1 << (get_num_threads() - 1).bit_length())
        return target if ctx.grad_buffer is None else None, None, None, None, None


@jit()
def eight_of(values, i):
    """The eight numbers of a row; as separate variables they stay in registers."""
    return (
        values[i, 0],
        values[i, 1],
        values[i, 2],
        values[i, 3],
        values[i, 4],
        values[i, 5],
        values[i, 6],
        values[i, 7],
    )


def _as_float(number):
    """An entry of a table, float32 or the bits of a bfloat16, as float32."""
    raise TypeError("compiled code alone calls this")


@overload(_as_float, inline="always")
def _as_float_of(number):
    if number == types.uint16:
        return lambda number: u32(u32(number) << u32(16)).view(np.float32)
    return lambda number: number


@jit(fastmath=FAST)
def blended(table, rows, weights, k):
    """Channel `k` of the sum of eight `rows` of `table` with `weights`."""
    r0, r1, r2, r3, r4, r5, r6, r7 = rows
    w0, w1, w2, w3, w4, w5, w6, w7 = weights
    return (
        w0 * _as_float(table[r0, k])
        + w1 * _as_float(table[r1, k])
        + w2 * _as_float(table[r2, k])
        + w3 * _as_float(table[r3, k])
        + w4 * _as_float(table[r4, k])
        + w5 * _as_float(table[r5, k])
        + w6 * _as_float(table[r6, k])
        + w7 * _as_float(table[r7, k])
    )


@jit(fastmath=FAST, parallel=True)
def _gather(table, corners, voxel, weights, out):
    total, channels = out.shape
    for chunk in prange((total + CHUNK - 1) // CHUNK):
        for i in range(chunk * CHUNK, min(total, (chunk + 1) * CHUNK)):
            rows, shares = eight_of(corners, voxel[i]), eight_of(weights, i)
            for k in range(channels):
                out[i, k] = blended(table, rows, shares, k)


@jit(fastmath=FAST, parallel=True)
def _scatter(grad, corners, voxel, weights, target, shares):
    """Adjoint of `_gather`: target[row] += weight * grad; `shares` is a power of 2."""
    total, channels = grad.shape
    for own in prange(shares):
        for i in range(total):
            v = voxel[i]
            for corner in range(8):
                row = corners[v, corner]
                if row & (shares - 1) == own:
                    w = weights[i, corner]
                    for k in range(channels):
                        target[row, k] += w * grad[i, k]

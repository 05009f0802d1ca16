"""Depthwise convolution of cells with numba: one cell at a time, all its channels at once."""

from __future__ import annotations

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from methods.kernels.cpu import arrays, check_float32, f32
from methods.steernerf_lean.kernels.depthwise import TAPS

CHUNKS = 16
"""Number of partial sums for the gradient of the weights; fixed, so that results are repeatable."""


def depthwise(x: Tensor, neighbours: Tensor, weight: Tensor) -> Tensor:
    """As the reference, of float32."""
    check_float32(x, weight)
    return _Depthwise.apply(x.contiguous(), neighbours.contiguous(), weight.contiguous())


class _Depthwise(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x, neighbours, weight):
        ctx.save_for_backward(x, neighbours, weight)
        out = torch.empty_like(x)
        _convolve(*arrays(x, neighbours, weight, out))
        return out

    @staticmethod
    def backward(ctx, grad):
        x, neighbours, weight = ctx.saved_tensors
        grad_x, parts = torch.empty_like(x), torch.zeros(CHUNKS, *weight.shape)
        # n is the k-th neighbour of m exactly if m is the (8 - k)-th of n: so the gradient is the
        # same convolution with reversed weights.
        _convolve(*arrays(grad, neighbours, weight.flip(0), grad_x))
        _correlate(*arrays(x, neighbours, grad, parts))
        return grad_x, None, parts.sum(dim=0)


@njit(cache=True, parallel=True, fastmath={"contract"})
def _convolve(x, neighbours, weight, out):
    channels = x.shape[1]
    for n in prange(len(x)):
        row = np.zeros(channels, f32)
        for k in range(TAPS):
            m = neighbours[n, k]
            if m >= 0:
                for c in range(channels):
                    row[c] += weight[k, c] * x[m, c]
        for c in range(channels):
            out[n, c] = row[c]


@njit(cache=True, parallel=True, fastmath={"contract"})
def _correlate(x, neighbours, grad, parts):
    count, channels = x.shape
    for chunk in prange(CHUNKS):
        for n in range(chunk * count // CHUNKS, (chunk + 1) * count // CHUNKS):
            for k in range(TAPS):
                m = neighbours[n, k]
                if m >= 0:
                    for c in range(channels):
                        parts[chunk, k, c] += x[m, c] * grad[n, c]

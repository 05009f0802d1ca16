"""Depthwise convolution of cells with numba: one cell at a time, all its channels at once."""

from __future__ import annotations

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from methods.kernels.cpu import f32
from methods.steernerf_lean.kernels.depthwise import TAPS

CHUNKS = 16
"""Number of partial sums for the gradient of the weights; fixed, so that results are repeatable."""


def depthwise(x: Tensor, neighbours: Tensor, weight: Tensor) -> Tensor:
    """As the reference, of float32."""
    if not x.dtype == weight.dtype == torch.float32:
        raise ValueError("backend 'cpu' convolves float32 only: use backend='reference'")
    return _Depthwise.apply(x, neighbours, weight)


class _Depthwise(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x, neighbours, weight):
        x, neighbours, weight = x.contiguous(), neighbours.contiguous(), weight.contiguous()
        ctx.save_for_backward(x, neighbours, weight)
        out = torch.empty_like(x)
        _convolve(*(part.detach().numpy() for part in (x, neighbours, weight)), out.numpy())
        return out

    @staticmethod
    def backward(ctx, grad):
        x, neighbours, weight = (part.detach() for part in ctx.saved_tensors)
        grad = grad.contiguous()
        # n is the k-th neighbour of m exactly if m is the (8 - k)-th of n: so the gradient is the
        # same convolution with reversed weights.
        grad_x = torch.empty_like(x)
        _convolve(grad.numpy(), neighbours.numpy(), weight.flip(0).numpy(), grad_x.numpy())
        parts = torch.zeros(CHUNKS, *weight.shape)
        _correlate(x.numpy(), neighbours.numpy(), grad.numpy(), parts.numpy())
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

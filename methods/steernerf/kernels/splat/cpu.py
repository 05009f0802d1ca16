"""Splatting with numba: each thread owns a band of rows and goes through all points in order.

No two threads write to the same pixel, and the result does not depend on their number.
"""

from __future__ import annotations

import numpy as np
import torch
from numba import get_num_threads, njit, prange
from torch import Tensor

from methods.kernels.cpu import i32
from methods.steernerf.kernels.splat import Rule


def splat(pixels: Tensor, depth: Tensor, width: int, height: int, rule: Rule) -> Tensor:
    """See `methods.steernerf.kernels.splat.splat`."""
    if not pixels.dtype == depth.dtype == torch.float32:
        raise ValueError(
            f"backend 'cpu' splats float32, got pixels {pixels.dtype}, depth {depth.dtype}: "
            "use backend='reference'"
        )
    index = torch.empty(height, width, dtype=torch.int32)
    _splat(
        pixels.contiguous().numpy(),
        depth.contiguous().numpy(),
        rule == "last",
        index.numpy(),
        get_num_threads(),
    )
    return index


def gather(values: Tensor, index: Tensor) -> Tensor:
    """See `methods.steernerf.kernels.splat.gather`."""
    if values.dtype != torch.float32:
        raise ValueError(
            f"backend 'cpu' gathers float32, got values {values.dtype}: use backend='reference'"
        )
    rows = _Gather.apply(values.contiguous(), index.contiguous().view(-1))
    return rows.view(*index.shape, values.shape[1])


class _Gather(torch.autograd.Function):
    @staticmethod
    def forward(ctx, values, index):
        ctx.save_for_backward(index)
        ctx.points = len(values)
        rows = torch.zeros(len(index), values.shape[1])
        _gather(values.detach().numpy(), index.numpy(), rows.numpy())
        return rows

    @staticmethod
    def backward(ctx, grad):
        (index,) = ctx.saved_tensors
        grad_values = torch.zeros(ctx.points, grad.shape[1])
        _scatter(grad.contiguous().numpy(), index.numpy(), grad_values.numpy())
        return grad_values, None


@njit(cache=True)
def _nearer(pixels, depth, a, b):
    """Whether point a lies before point b: by depth, then u, then v."""
    if depth[a] != depth[b]:
        return depth[a] < depth[b]
    if pixels[a, 0] != pixels[b, 0]:
        return pixels[a, 0] < pixels[b, 0]
    return pixels[a, 1] < pixels[b, 1]


@njit(cache=True, parallel=True)
def _splat(pixels, depth, last, index, bands):
    height, width = index.shape
    for band in prange(bands):
        top, bottom = height * band // bands, height * (band + 1) // bands
        index[top:bottom] = -1
        for point in range(len(depth)):
            u, v, z = pixels[point, 0], pixels[point, 1], depth[point]
            # Compared as floats, where comparisons with NaN are false; converting huge or
            # non-finite values to integers is undefined.
            if top <= v < bottom and 0 <= u < width and 0 < z < np.inf:
                row, column = int(v), int(u)  # not negative: truncation is floor
                shown = index[row, column]
                # The index serves as z-buffer: the depth of the shown point is looked up.
                if shown < 0 or last or _nearer(pixels, depth, point, shown):
                    index[row, column] = i32(point)


@njit(cache=True, parallel=True)
def _gather(values, index, rows):
    """Fill in the rows of pixels that show a point; the others (most) are zero already."""
    for i in prange(len(index)):
        if index[i] >= 0:
            for channel in range(values.shape[1]):
                rows[i, channel] = values[index[i], channel]


@njit(cache=True)
def _scatter(grad, index, grad_values):
    """Adjoint of `_gather`. Single-threaded: reading the index takes as long as adding."""
    for i in range(len(index)):
        if index[i] >= 0:
            for channel in range(grad.shape[1]):
                grad_values[index[i], channel] += grad[i, channel]

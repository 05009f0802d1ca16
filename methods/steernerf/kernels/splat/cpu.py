"""Splatting with numba: each thread owns a band of rows and goes through all points in order.

No two threads write to the same pixel, and the result does not depend on their number.
"""

from __future__ import annotations

import numpy as np
import torch
from numba import get_num_threads, njit, prange
from torch import Tensor

from methods.kernels.cpu import arrays, check_float32, i32


def splat(pixels: Tensor, depth: Tensor, width: int, height: int) -> Tensor:
    """The last point in each pixel."""
    check_float32(pixels, depth)
    index = torch.empty(height, width, dtype=torch.int32)
    _splat(*arrays(pixels, depth, index), get_num_threads())
    return index


def gather(values: Tensor, index: Tensor) -> Tensor:
    """The rows [P, C] of the points that pixels show."""
    check_float32(values)
    rows = torch.zeros(len(index), values.shape[1])
    _gather(*arrays(values, index, rows))
    return rows


def scatter(rows: Tensor, index: Tensor, points: int) -> Tensor:
    """Sums [points, C] of the `rows` of the pixels that show each point."""
    sums = torch.zeros(points, rows.shape[1])
    _scatter(*arrays(rows, index, sums))
    return sums


@njit(cache=True, parallel=True)
def _splat(pixels, depth, index, bands):
    height, width = index.shape
    for band in prange(bands):
        top, bottom = height * band // bands, height * (band + 1) // bands
        index[top:bottom] = -1
        for point in range(len(depth)):
            u, v, z = pixels[point, 0], pixels[point, 1], depth[point]
            # Compared as floats, where comparisons with NaN are false; converting huge or
            # non-finite values to integers is undefined. Not negative: truncation is floor.
            if top <= v < bottom and 0 <= u < width and 0 < z < np.inf:
                index[int(v), int(u)] = i32(point)


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

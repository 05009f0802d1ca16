"""Splatting with numba: each thread owns a band of rows and goes through all points in order.

No two threads write to the same pixel, and the result does not depend on their number.
"""

from __future__ import annotations

import numpy as np
from numba import get_num_threads, prange
from torch import Tensor

from methods.kernels.cpu import arrays, check_float32, i32, jit


def splat(pixels: Tensor, depth: Tensor, first: int, index: Tensor) -> None:
    """As the reference, of float32."""
    check_float32(pixels, depth)
    _splat(*arrays(pixels, depth), first, index.numpy(), get_num_threads())


@jit(parallel=True)
def _splat(pixels, depth, first, index, bands):
    height, width = index.shape
    for band in prange(bands):
        top, bottom = height * band // bands, height * (band + 1) // bands
        for point in range(len(depth)):
            u, v, z = pixels[point, 0], pixels[point, 1], depth[point]
            # Compared as floats, where comparisons with NaN are false; converting huge or
            # non-finite values to integers is undefined. Not negative: truncation is floor.
            if top <= v < bottom and 0 <= u < width and 0 < z < np.inf:
                index[int(v), int(u)] = i32(first + point)

"""SSIM with numba: row by row, window first vertical then horizontal, with derivatives.

A row of pixels is a row of 3 W numbers: neighbours in a channel are three numbers apart, and every
loop runs over consecutive numbers. Windows in which the pictures are equal are skipped.
"""

import numpy as np
import torch
from numba import prange
from torch import Tensor

from methods.gaussians.kernels.ssim import C1, C2, REACH, WINDOW
from methods.kernels.cpu import arrays, check_float32, f32, jit

WEIGHTS = np.array(WINDOW, np.float32)
MARGIN = 3 * REACH
ONE, TWO, C1_32, C2_32 = f32(1), f32(2), f32(C1), f32(C2)


def ssim(picture: Tensor, target: Tensor) -> Tensor:
    check_float32(picture, target)
    if target.requires_grad:
        raise ValueError("backend 'cpu' gives no gradient for target: use backend='reference'")
    return _Ssim.apply(picture.flatten(1), target.flatten(1))


class _Ssim(torch.autograd.Function):
    @staticmethod
    def forward(ctx, picture, target):
        rows = arrays(picture, target)
        height = len(picture)
        spans, seen = np.empty((2, height, 2), np.int64)
        _different(*rows, spans)
        slopes, sums = torch.empty(3, *picture.shape), torch.empty(height, dtype=torch.float64)
        _compare(*rows, spans, slopes.numpy(), sums.numpy(), seen)
        ctx.save_for_backward(picture, target, slopes)
        ctx.seen = seen
        return (sums.sum() / picture.numel()).float()

    @staticmethod
    def backward(ctx, grad):
        *rows, slopes = arrays(*ctx.saved_tensors)
        grads = torch.zeros(rows[0].shape)
        _spread(*rows, slopes, ctx.seen, grads.numpy())
        return grads * (grad / grads.numel()), None


@jit(fastmath={"contract"})
def _add(out, weight, x):
    for i in range(len(out)):
        out[i] += weight * x[i]


@jit(fastmath={"contract"})
def _add_product(out, weight, x, y):
    for i in range(len(out)):
        out[i] += weight * x[i] * y[i]


@jit()
def _across(out, padded):
    """Apply the window along a row with `MARGIN` zeros on both sides."""
    out[:] = f32(0)
    for k in range(len(WEIGHTS)):
        _add(out, WEIGHTS[k], padded[3 * k : 3 * k + len(out)])


@jit(parallel=True)
def _different(picture, target, spans):
    """The range [low, high) of each row in which the pictures differ; 0, 0 if nowhere."""
    height, size = picture.shape
    for row in prange(height):
        low, high = 0, size
        while low < size and picture[row, low] == target[row, low]:
            low += 1
        while high > low and picture[row, high - 1] == target[row, high - 1]:
            high -= 1
        spans[row, 0], spans[row, 1] = (low, high) if low < high else (0, 0)


@jit()
def _reached(spans, row, size):
    """The range [low, high) of window centres on `row` whose window may see any of `spans`."""
    low, high = size, 0
    for other in range(max(row - REACH, 0), min(row + REACH + 1, len(spans))):
        if spans[other, 0] < spans[other, 1]:
            low, high = min(low, spans[other, 0]), max(high, spans[other, 1])
    return (max(low - MARGIN, 0), min(high + MARGIN, size)) if low < high else (0, 0)


@jit(parallel=True)
def _compare(picture, target, spans, slopes, sums, seen):
    """Sums of the similarity of each row; its derivatives by the mean of x, of x x and of x y. Only
    windows from which a difference can be `seen` are computed: where both pictures are equal, the
    similarity is 1 and has no gradient, because that is the maximum."""
    height, size = picture.shape
    for row in prange(height):
        low, high = _reached(spans, row, size)
        seen[row, 0], seen[row, 1] = low, high
        sums[row] = size - (high - low)
        if low == high:
            continue
        left, right = max(low - MARGIN, 0), min(high + MARGIN, size)  # covered by the windows
        padded = np.zeros((5, high - low + 2 * MARGIN), np.float32)
        start = left - (low - MARGIN)
        down = padded[:, start : start + right - left]
        for other in range(max(row - REACH, 0), min(row + REACH + 1, height)):
            weight = WEIGHTS[other - row + REACH]
            x, y = picture[other, left:right], target[other, left:right]
            _add(down[0], weight, x)
            _add(down[1], weight, y)
            _add_product(down[2], weight, x, x)
            _add_product(down[3], weight, y, y)
            _add_product(down[4], weight, x, y)
        means = np.empty((5, high - low), np.float32)
        for k in range(5):
            _across(means[k], padded[k])
        by_mean, by_square, by_product = slopes[:, row, low:high]
        sums[row] += _slopes(means, by_mean, by_square, by_product)


@jit(fastmath={"contract", "reassoc"}, error_model="numpy")
def _slopes(means, by_mean, by_square, by_product):
    total = 0.0
    for i in range(means.shape[1]):
        mx, my, xx, yy, xy = means[0, i], means[1, i], means[2, i], means[3, i], means[4, i]
        a1 = TWO * mx * my + C1_32
        a2 = TWO * (xy - mx * my) + C2_32
        b1 = mx * mx + my * my + C1_32
        b2 = xx - mx * mx + yy - my * my + C2_32
        inverse = ONE / (b1 * b2)
        similarity = a1 * a2 * inverse
        total += similarity
        by_square[i] = -similarity / b2
        by_product[i] = TWO * a1 * inverse
        by_mean[i] = TWO * my * (a2 - a1) * inverse - TWO * mx * similarity * (ONE / b1 - ONE / b2)
    return total


@jit(parallel=True)
def _spread(picture, target, slopes, seen, grads):
    """The gradient of the sum: each derivative is spread over all pixels under its window."""
    height, size = picture.shape
    for row in prange(height):
        low, high = _reached(seen, row, size)
        if low == high:
            continue
        padded = np.zeros((3, high - low + 2 * MARGIN), np.float32)
        for other in range(max(row - REACH, 0), min(row + REACH + 1, height)):
            left, right = seen[other]
            start = left - (low - MARGIN)
            for k in range(3):
                down = padded[k, start : start + right - left]
                _add(down, WEIGHTS[row - other + REACH], slopes[k, other, left:right])
        blurred = np.empty((3, high - low), np.float32)
        for k in range(3):
            _across(blurred[k], padded[k])
        for i in range(high - low):
            x, y = picture[row, low + i], target[row, low + i]
            grads[row, low + i] = blurred[0, i] + TWO * x * blurred[1, i] + y * blurred[2, i]

"""Depthwise convolution of cells with Triton: a program handles a block of cells, all channels.

A cell reads 36 bytes of neighbour indices and 9 rows of 4 C bytes; about one row comes from memory,
the others from the cache, shared with nearby cells. It writes 4 C bytes. For the gradient of the
weights, a program handles some cells and one tap: rows of input and gradient are read 9 times each,
once from memory and then mostly from the L2 cache.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from methods.kernels import depthwise as interface
from methods.kernels.gpu import check_types, launch

BLOCK = 1024
"""Numbers per program at a time, 8 per lane: that many loads hide their latency."""

BLOCKS = 16
"""Blocks per partial sum of the gradient of the weights: few partial sums, but enough to keep a GPU
busy with the cells of a frame."""

TAPS = tl.constexpr(interface.TAPS)


def depthwise(x: Tensor, neighbours: Tensor, weight: Tensor) -> Tensor:
    """See `methods.steernerf_lean.kernels.depthwise.depthwise`."""
    check_types(torch.float32, x=x, weight=weight)
    return _Depthwise.apply(x, neighbours, weight)


class _Depthwise(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x, neighbours, weight):
        x, neighbours, weight = x.contiguous(), neighbours.contiguous(), weight.contiguous()
        ctx.save_for_backward(x, neighbours, weight)
        return _convolved(x.detach(), neighbours, weight.detach())

    @staticmethod
    def backward(ctx, grad):
        x, neighbours, weight = ctx.saved_tensors
        grad = grad.contiguous()
        # n is the k-th neighbour of m exactly if m is the (8 - k)-th of n: so the gradient is the
        # same convolution with reversed weights.
        grad_x = _convolved(grad, neighbours, weight.flip(0))
        rows, width = _block(x)
        count = triton.cdiv(len(x), BLOCKS * rows)
        # Partial sums, always the same ones, so that results are repeatable.
        parts = x.new_empty(count, *weight.shape)
        given = x, neighbours, grad, parts, *x.shape
        grid = count, interface.TAPS
        launch(_correlate, grid, *given, ROWS=rows, WIDTH=width, BLOCKS=BLOCKS)
        return grad_x, None, parts.sum(dim=0)


def _block(x: Tensor) -> tuple[int, int]:
    """Number of cells and channels in a block."""
    width = triton.next_power_of_2(max(x.shape[1], 1))
    return max(BLOCK // width, 1), width


def _convolved(x: Tensor, neighbours: Tensor, weight: Tensor) -> Tensor:
    out = torch.empty_like(x)
    rows, width = _block(x)
    given = x, neighbours, weight, out, *x.shape
    launch(_convolve, (triton.cdiv(len(x), rows),), *given, ROWS=rows, WIDTH=width)
    return out


@triton.jit
def _convolve(x, neighbours, weight, out, cells, channels, ROWS: tl.constexpr, WIDTH: tl.constexpr):
    n = tl.program_id(0).to(tl.int64) * ROWS + tl.arange(0, ROWS)
    c = tl.arange(0, WIDTH)
    inside, there = n < cells, c < channels
    total = tl.zeros([ROWS, WIDTH], tl.float32)
    for k in tl.static_range(TAPS):
        row = _neighbour(x, neighbours, n, k, inside, c, there, channels)
        total += row * tl.load(weight + k * channels + c, mask=there, other=0.0)[None, :]
    place = out + n[:, None] * channels + c[None, :]
    tl.store(place, total, mask=inside[:, None] & there[None, :])


@triton.jit
def _correlate(
    x,
    neighbours,
    grad,
    parts,
    cells,
    channels,
    ROWS: tl.constexpr,
    WIDTH: tl.constexpr,
    BLOCKS: tl.constexpr,
):
    """parts[p, k] = the sum, over the cells n of part p, of x[neighbours[n, k]] grad[n]."""
    part, k = tl.program_id(0).to(tl.int64), tl.program_id(1)
    c = tl.arange(0, WIDTH)
    there = c < channels
    total = tl.zeros([ROWS, WIDTH], tl.float32)
    for block in range(BLOCKS):
        n = (part * BLOCKS + block) * ROWS + tl.arange(0, ROWS)
        inside = n < cells
        row = _neighbour(x, neighbours, n, k, inside, c, there, channels)
        place = grad + n[:, None] * channels + c[None, :]
        total += row * tl.load(place, mask=inside[:, None] & there[None, :], other=0.0)
    tl.store(parts + (part * TAPS + k) * channels + c, tl.sum(total, 0), mask=there)


@triton.jit
def _neighbour(x, neighbours, n, k, inside, c, there, channels):
    """Rows of `x` for the k-th neighbours of cells; 0 where there is none."""
    m = tl.load(neighbours + n * TAPS + k, mask=inside, other=-1).to(tl.int64)
    place = x + m[:, None] * channels + c[None, :]
    return tl.load(place, mask=(m >= 0)[:, None] & there[None, :], other=0.0)

"""SSIM with Triton: one lane per number, window first vertical then horizontal.

Between the two passes, five maps are written and read, 20 bytes per number; neighbours share rows
through the cache. The similarity is summed in fixed parts, so that results are repeatable.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from methods.kernels import ssim as interface
from methods.kernels.dispatch import interpreted
from methods.kernels.gpu import check_types, launch

BLOCK = 1 << 16 if interpreted() else 512
"""Numbers per program, 4 per lane. The interpreter takes as long for many as for few."""

WINDOW = tl.constexpr(interface.WINDOW)
REACH, TAPS = tl.constexpr(interface.REACH), tl.constexpr(len(interface.WINDOW))
C1, C2 = tl.constexpr(interface.C1), tl.constexpr(interface.C2)


def ssim(picture: Tensor, target: Tensor) -> Tensor:
    """See `methods.gaussians.kernels.ssim.ssim`."""
    check_types(torch.float32, picture=picture, target=target)
    if target.requires_grad:
        raise ValueError("backend 'gpu' gives no gradient for target: use backend='reference'")
    return _Ssim.apply(picture, target.contiguous())


class _Ssim(torch.autograd.Function):
    @staticmethod
    def forward(ctx, picture, target):
        picture = picture.detach().contiguous()
        maps, slopes = (picture.new_empty(count, *picture.shape) for count in (5, 3))
        sums = picture.new_empty(triton.cdiv(picture.numel(), BLOCK))
        _launch(_pair_down, picture, target, maps)
        _launch(_compare, maps, slopes, sums)
        ctx.save_for_backward(picture, target, slopes)
        return (sums.double().sum() / picture.numel()).float()

    @staticmethod
    def backward(ctx, grad):
        picture, target, slopes = ctx.saved_tensors
        maps, grads = torch.empty_like(slopes), torch.empty_like(picture)
        _launch(_slopes_down, slopes, maps)
        _launch(_spread, picture, target, maps, grads)
        return grads * (grad / picture.numel()), None


def _launch(kernel: triton.JITFunction, *given: Tensor) -> None:
    """Run `kernel` with one lane per number of a picture; a row is 3 W numbers.

    The size is that of a map of the first tensor in `given`.
    """
    height, width = given[0].shape[-3:-1]
    total = 3 * height * width
    launch(kernel, (triton.cdiv(total, BLOCK),), *given, total, 3 * width, BLOCK=BLOCK)


@triton.jit
def _place(total, columns, BLOCK: tl.constexpr):
    """The numbers of a program, their columns, and the mask of those that exist."""
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    return i, i % columns, i < total


@triton.jit
def _tap(numbers, i, step, first, end, inside):
    """The numbers at `i` + `step`; 0 before `first` and from `end` on."""
    there = inside & (i + step >= first) & (i + step < end)
    return tl.load(numbers + i + step, mask=there, other=0.0)


@triton.jit
def _across(numbers, i, column, columns, inside):
    """Apply the window along a row."""
    blurred, first = tl.zeros(i.shape, tl.float32), i - column
    for tap in tl.static_range(TAPS):
        near = _tap(numbers, i, 3 * (tap - REACH), first, first + columns, inside)
        blurred += WINDOW[tap] * near
    return blurred


@triton.jit
def _pair_down(picture, target, maps, total, columns, BLOCK: tl.constexpr):
    """Apply the window along columns to x, y, x x, y y and x y."""
    i, _, inside = _place(total, columns, BLOCK)
    mean_x = tl.zeros([BLOCK], tl.float32)
    mean_y, xx, yy, xy = mean_x, mean_x, mean_x, mean_x
    for tap in tl.static_range(TAPS):
        step = (tap - REACH) * columns
        x = _tap(picture, i, step, 0, total, inside)
        y = _tap(target, i, step, 0, total, inside)
        mean_x += WINDOW[tap] * x
        mean_y += WINDOW[tap] * y
        xx += WINDOW[tap] * (x * x)
        yy += WINDOW[tap] * (y * y)
        xy += WINDOW[tap] * (x * y)
    out = maps + i
    tl.store(out, mean_x, mask=inside)
    tl.store(out + total, mean_y, mask=inside)
    tl.store(out + 2 * total, xx, mask=inside)
    tl.store(out + 3 * total, yy, mask=inside)
    tl.store(out + 4 * total, xy, mask=inside)


@triton.jit
def _compare(maps, slopes, sums, total, columns, BLOCK: tl.constexpr):
    """Apply the window along rows; sum the similarity, and write its derivatives.

    These are by the mean of x, of x x and of x y.
    """
    i, column, inside = _place(total, columns, BLOCK)
    x = _across(maps, i, column, columns, inside)
    y = _across(maps + total, i, column, columns, inside)
    xx = _across(maps + 2 * total, i, column, columns, inside)
    yy = _across(maps + 3 * total, i, column, columns, inside)
    xy = _across(maps + 4 * total, i, column, columns, inside)
    a1, a2 = 2 * x * y + C1, 2 * (xy - x * y) + C2
    b1, b2 = x * x + y * y + C1, xx - x * x + yy - y * y + C2
    inverse = 1 / (b1 * b2)
    similarity = a1 * a2 * inverse
    by_mean = 2 * y * (a2 - a1) * inverse - 2 * x * similarity * (1 / b1 - 1 / b2)
    tl.store(slopes + i, by_mean, mask=inside)
    tl.store(slopes + total + i, -similarity / b2, mask=inside)
    tl.store(slopes + 2 * total + i, 2 * a1 * inverse, mask=inside)
    tl.store(sums + tl.program_id(0), tl.sum(tl.where(inside, similarity, 0.0), 0))


@triton.jit
def _slopes_down(slopes, maps, total, columns, BLOCK: tl.constexpr):
    """Apply the window along columns to each derivative."""
    i, _, inside = _place(total, columns, BLOCK)
    for k in tl.static_range(3):
        blurred = tl.zeros([BLOCK], tl.float32)
        for tap in tl.static_range(TAPS):
            near = _tap(slopes + k * total, i, (tap - REACH) * columns, 0, total, inside)
            blurred += WINDOW[tap] * near
        tl.store(maps + k * total + i, blurred, mask=inside)


@triton.jit
def _spread(picture, target, maps, grads, total, columns, BLOCK: tl.constexpr):
    """The gradient of the sum: each derivative is spread over all pixels under its window."""
    i, column, inside = _place(total, columns, BLOCK)
    by_mean = _across(maps, i, column, columns, inside)
    by_square = _across(maps + total, i, column, columns, inside)
    by_product = _across(maps + 2 * total, i, column, columns, inside)
    x = tl.load(picture + i, mask=inside, other=0.0)
    y = tl.load(target + i, mask=inside, other=0.0)
    tl.store(grads + i, by_mean + 2 * x * by_square + y * by_product, mask=inside)

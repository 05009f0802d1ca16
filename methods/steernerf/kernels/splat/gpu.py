"""Splatting with Triton: one lane per point; points compete for their pixel with atomics.

Keys are processed one by one: the smallest depth of every pixel, then among points with that depth
the smallest u, then v, then index. A minimum does not depend on the order of the atomics, so that
the result is repeatable.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from methods.kernels.gpu import check_types, launch
from methods.steernerf.kernels.splat import Rule

BLOCK = 256
NOTHING = torch.iinfo(torch.int32).max


def splat(pixels: Tensor, depth: Tensor, width: int, height: int, rule: Rule) -> Tensor:
    """See `methods.steernerf.kernels.splat.splat`."""
    check_types(torch.float32, pixels=pixels, depth=depth)
    index = torch.full((height, width), -1, dtype=torch.int32, device=depth.device)
    given = (pixels.contiguous(), depth.contiguous(), len(depth), width, height)
    grid, options = (triton.cdiv(len(depth), BLOCK),), {"BLOCK": BLOCK}
    if rule == "last":
        launch(_splat_last, grid, *given, index, **options)
        return index
    least = torch.full((4, height, width), NOTHING, dtype=torch.int32, device=depth.device)
    for key in range(4):
        launch(_compete, grid, *given, width * height, least, KEY=key, **options)
    return torch.where(least[3] < NOTHING, least[3], index)


def gather(values: Tensor, index: Tensor) -> Tensor:
    """See `methods.steernerf.kernels.splat.gather`."""
    check_types(torch.float32, values=values)
    rows = _Gather.apply(values.contiguous(), index.contiguous().view(-1))
    return rows.view(*index.shape, values.shape[1])


class _Gather(torch.autograd.Function):
    @staticmethod
    def forward(ctx, values, index):
        ctx.save_for_backward(index)
        ctx.points = len(values)
        rows = values.new_zeros(len(index), values.shape[1])
        _move(_gather, values.detach(), index, rows)
        return rows

    @staticmethod
    def backward(ctx, grad):
        (index,) = ctx.saved_tensors
        grad_values = grad.new_zeros(ctx.points, grad.shape[1])
        if torch.are_deterministic_algorithms_enabled():
            shown = index >= 0
            grad_values.index_put_((index[shown].long(),), grad[shown], accumulate=True)
        else:
            _move(_scatter, grad_values, index, grad.contiguous())
        return grad_values, None


def _move(kernel: triton.JITFunction, values: Tensor, index: Tensor, rows: Tensor) -> None:
    """Run `kernel`, which moves data between `values` [N, C] and `rows` [P, C] = values[index]."""
    grid = (triton.cdiv(rows.numel(), BLOCK),)
    launch(kernel, grid, values, index, rows, rows.numel(), rows.shape[1], BLOCK=BLOCK)


@triton.jit
def _pixel(pixels, depth, points, width, height, i):
    """u, v and depth of points, their pixel, and whether they count.

    Compared as floats, where comparisons with NaN are false; converting huge or non-finite values
    to integers is undefined. Adding 0 turns -0 into 0, so that both are the same position.
    """
    inside = i < points
    u = tl.load(pixels + 2 * i, mask=inside, other=-1.0) + 0.0
    v = tl.load(pixels + 2 * i + 1, mask=inside, other=-1.0) + 0.0
    z = tl.load(depth + i, mask=inside, other=-1.0)
    shown = inside & (u >= 0) & (u < width) & (v >= 0) & (v < height)
    shown = shown & (z > 0) & (z < float("inf"))
    row = tl.where(shown, v, 0.0).to(tl.int64)
    return u, v, z, row * width + tl.where(shown, u, 0.0).to(tl.int64), shown


@triton.jit
def _compete(
    pixels, depth, points, width, height, size, least, KEY: tl.constexpr, BLOCK: tl.constexpr
):
    """Update the minimum of `KEY` (depth, u, v or index) in `least` [4, H, W]; `size` is H W.

    Only points that have the minimum of all previous keys take part. Bits of non-negative floats
    are ordered like integers.
    """
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    u, v, z, pixel, shown = _pixel(pixels, depth, points, width, height, i)
    z_bits = z.to(tl.int32, bitcast=True)
    u_bits, v_bits = u.to(tl.int32, bitcast=True), v.to(tl.int32, bitcast=True)
    if KEY > 0:
        shown = shown & (tl.load(least + pixel, mask=shown, other=0) == z_bits)
    if KEY > 1:
        shown = shown & (tl.load(least + size + pixel, mask=shown, other=0) == u_bits)
    if KEY > 2:
        shown = shown & (tl.load(least + 2 * size + pixel, mask=shown, other=0) == v_bits)
    if KEY == 0:
        key = z_bits
    elif KEY == 1:
        key = u_bits
    elif KEY == 2:
        key = v_bits
    else:
        key = i.to(tl.int32)
    tl.atomic_min(least + KEY * size + pixel, key, mask=shown, sem="relaxed")


@triton.jit
def _splat_last(pixels, depth, points, width, height, index, BLOCK: tl.constexpr):
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    _, _, _, pixel, shown = _pixel(pixels, depth, points, width, height, i)
    tl.atomic_max(index + pixel, i.to(tl.int32), mask=shown, sem="relaxed")


@triton.jit
def _gather(values, index, rows, total, channels, BLOCK: tl.constexpr):
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    point = tl.load(index + i // channels, mask=i < total, other=-1).to(tl.int64)
    shown = point >= 0
    tl.store(rows + i, tl.load(values + point * channels + i % channels, mask=shown), mask=shown)


@triton.jit
def _scatter(values, index, rows, total, channels, BLOCK: tl.constexpr):
    """Adjoint of `_gather`."""
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    point = tl.load(index + i // channels, mask=i < total, other=-1).to(tl.int64)
    shown = point >= 0
    share = tl.load(rows + i, mask=shown, other=0.0)
    tl.atomic_add(values + point * channels + i % channels, share, mask=shown, sem="relaxed")

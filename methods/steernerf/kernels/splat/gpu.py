"""Splatting with Triton: one lane per point; points compete for their pixel with atomics. A maximum
does not depend on their order, so that the result is repeatable."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from methods.kernels.gpu import check_types, launch

BLOCK = 256


def splat(pixels: Tensor, depth: Tensor, width: int, height: int) -> Tensor:
    """The last point in each pixel."""
    check_types(torch.float32, pixels=pixels, depth=depth)
    index = torch.full((height, width), -1, dtype=torch.int32, device=depth.device)
    given = (pixels.contiguous(), depth.contiguous(), len(depth), width, height)
    launch(_splat, (triton.cdiv(len(depth), BLOCK),), *given, index, BLOCK=BLOCK)
    return index


def gather(values: Tensor, index: Tensor) -> Tensor:
    """The rows [P, C] of the points that pixels show."""
    check_types(torch.float32, values=values)
    rows = values.new_zeros(len(index), values.shape[1])
    _move(_gather, values, index, rows)
    return rows


def scatter(rows: Tensor, index: Tensor, points: int) -> Tensor:
    """Sums [points, C] of the `rows` of the pixels that show each point."""
    sums = rows.new_zeros(points, rows.shape[1])
    _move(_scatter, sums, index, rows)
    return sums


def _move(kernel: triton.JITFunction, values: Tensor, index: Tensor, rows: Tensor) -> None:
    """Run `kernel`, which moves data between `values` [N, C] and `rows` [P, C] = values[index]."""
    grid = (triton.cdiv(rows.numel(), BLOCK),)
    launch(kernel, grid, values, index, rows, rows.numel(), rows.shape[1], BLOCK=BLOCK)


@triton.jit
def _splat(pixels, depth, points, width, height, index, BLOCK: tl.constexpr):
    """Compared as floats, as on a CPU."""
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    u = tl.load(pixels + 2 * i, mask=i < points, other=-1.0)
    v = tl.load(pixels + 2 * i + 1, mask=i < points, other=-1.0)
    z = tl.load(depth + i, mask=i < points, other=-1.0)
    shown = (u >= 0) & (u < width) & (v >= 0) & (v < height) & (z > 0) & (z < float("inf"))
    row = tl.where(shown, v, 0.0).to(tl.int64)
    pixel = row * width + tl.where(shown, u, 0.0).to(tl.int64)
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

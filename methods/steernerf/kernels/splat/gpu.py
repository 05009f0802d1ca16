"""Splatting with Triton: one lane per point; points compete for their pixel with atomics. A maximum
does not depend on their order, so that the result is repeatable."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from methods.kernels.gpu import check_types, launch

BLOCK = 256


def splat(pixels: Tensor, depth: Tensor, first: int, index: Tensor) -> None:
    """As the reference, of float32."""
    check_types(torch.float32, pixels=pixels, depth=depth)
    given = (pixels.contiguous(), depth.contiguous(), len(depth), first, *reversed(index.shape))
    launch(_splat, (triton.cdiv(len(depth), BLOCK),), *given, index, BLOCK=BLOCK)


@triton.jit
def _splat(pixels, depth, points, first, width, height, index, BLOCK: tl.constexpr):
    """Compared as floats, as on a CPU."""
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    u = tl.load(pixels + 2 * i, mask=i < points, other=-1.0)
    v = tl.load(pixels + 2 * i + 1, mask=i < points, other=-1.0)
    z = tl.load(depth + i, mask=i < points, other=-1.0)
    shown = (u >= 0) & (u < width) & (v >= 0) & (v < height) & (z > 0) & (z < float("inf"))
    row = tl.where(shown, v, 0.0).to(tl.int64)
    pixel = row * width + tl.where(shown, u, 0.0).to(tl.int64)
    tl.atomic_max(index + pixel, (first + i).to(tl.int32), mask=shown, sem="relaxed")

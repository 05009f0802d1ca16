"""Splatting with Triton: one lane per point; points compete for their pixel with atomics. A maximum
does not depend on their order, so that the result is repeatable."""

import torch
import triton
import triton.language as tl
from torch import Tensor

from methods.kernels.gpu import check_types, launch

BLOCK = 256


def splat(pixels: Tensor, depth: Tensor, width: int, height: int, last: Tensor) -> Tensor:
    check_types(torch.float32, pixels=pixels, depth=depth)
    landed = torch.empty(len(depth), dtype=torch.int64, device=depth.device)
    size = width, height, width * height
    given = pixels.contiguous(), depth.contiguous(), len(depth), *size, last, landed
    launch(_splat, (triton.cdiv(len(depth), BLOCK),), *given, BLOCK=BLOCK)
    return landed


@triton.jit
def _splat(pixels, depth, points, width, height, nowhere, last, landed, BLOCK: tl.constexpr):
    """Compared as floats, as by the reference."""
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    u = tl.load(pixels + 2 * i, mask=i < points, other=-1.0)
    v = tl.load(pixels + 2 * i + 1, mask=i < points, other=-1.0)
    z = tl.load(depth + i, mask=i < points, other=-1.0)
    taken = (u >= 0) & (u < width) & (v >= 0) & (v < height) & (z > 0) & (z < float("inf"))
    row = tl.where(taken, v, 0.0).to(tl.int64)
    pixel = row * width + tl.where(taken, u, 0.0).to(tl.int64)
    tl.atomic_max(last + pixel, i.to(tl.int32), mask=taken, sem="relaxed")
    tl.store(landed + i, tl.where(taken, pixel, nowhere), mask=i < points)

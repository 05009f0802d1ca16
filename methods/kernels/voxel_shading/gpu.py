"""Colours of voxels with Triton: one lane per colour, coefficients are read in place.

In the backward pass a program handles a block of voxels with all their coefficients and adds with
atomics, whose order is not repeatable. If torch is set to use deterministic algorithms, torch's
sorted scatter is used instead.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from methods.kernels.gpu import check_types, gradient, launch, vector
from methods.kernels.spherical import CHANNELS, spherical_harmonics

BLOCK = 1024
"""Gradients per program, 8 per lane."""

LANES = 128
"""Colours per program, one per lane."""

BASIS = tl.constexpr(CHANNELS)


def shade_voxels(
    harmonics: Tensor, voxel: Tensor, ray: Tensor, directions: Tensor, grad_buffer: Tensor | None
) -> Tensor:
    """See `methods.kernels.voxel_shading.shade_voxels`."""
    check_types(torch.float32, harmonics=harmonics, directions=directions)
    basis = spherical_harmonics(directions, backend="gpu")
    return _Shade.apply(harmonics, voxel.contiguous(), ray.contiguous(), basis, grad_buffer)


class _Shade(torch.autograd.Function):
    @staticmethod
    def forward(ctx, harmonics, voxel, ray, basis, grad_buffer):
        size, count = harmonics.shape[1], len(voxel)
        colours = basis.new_empty(count, 3)
        given = harmonics.detach().contiguous(), voxel, ray, basis, colours, count
        launch(_shade, (triton.cdiv(count, LANES),), *given, SIZE=size, LANES=LANES)
        ctx.save_for_backward(voxel, ray, basis, colours)
        ctx.shape, ctx.grad_buffer = harmonics.shape, grad_buffer
        return colours

    @staticmethod
    def backward(ctx, grad):
        voxel, ray, basis, colours = ctx.saved_tensors
        size, buffer = ctx.shape[1], ctx.grad_buffer
        slope = (grad * colours * (1 - colours)).contiguous()  # of the sigmoid
        with gradient(buffer, ctx.shape, grad.device) as target:
            if torch.are_deterministic_algorithms_enabled():
                shares = basis[ray.long(), :size, None] * slope[:, None]
                target.index_put_((voxel.long(),), shares, accumulate=True)
            else:
                width = triton.next_power_of_2(3 * size)
                rows = BLOCK // width
                grid, given = (triton.cdiv(len(voxel), rows),), (target, voxel, ray, basis, slope)
                launch(_scatter, grid, *given, len(voxel), SIZE=size, ROWS=rows, WIDTH=width)
        return target if buffer is None else None, None, None, None, None


@triton.jit
def _shade(harmonics, voxel, ray, basis, colours, count, SIZE: tl.constexpr, LANES: tl.constexpr):
    i = tl.program_id(0).to(tl.int64) * LANES + tl.arange(0, LANES)
    inside = i < count
    v = tl.load(voxel + i, mask=inside, other=0).to(tl.int64)
    r = tl.load(ray + i, mask=inside, other=0).to(tl.int64)
    red = tl.zeros([LANES], tl.float32)
    green, blue = red, red
    for k in tl.static_range(SIZE):
        share = tl.load(basis + r * BASIS + k, mask=inside, other=0.0)
        of_red, of_green, of_blue = vector(harmonics, v * SIZE + k, inside)
        red += share * of_red
        green += share * of_green
        blue += share * of_blue
    tl.store(colours + 3 * i, tl.sigmoid(red), mask=inside)
    tl.store(colours + 3 * i + 1, tl.sigmoid(green), mask=inside)
    tl.store(colours + 3 * i + 2, tl.sigmoid(blue), mask=inside)


@triton.jit
def _scatter(
    target,
    voxel,
    ray,
    basis,
    slope,
    count,
    SIZE: tl.constexpr,
    ROWS: tl.constexpr,
    WIDTH: tl.constexpr,
):
    """Adjoint of the sums of `_shade`: target[voxel] += Y(d) slope."""
    i = tl.program_id(0).to(tl.int64) * ROWS + tl.arange(0, ROWS)
    column = tl.arange(0, WIDTH)
    inside = i < count
    there = inside[:, None] & (column < 3 * SIZE)[None, :]
    v = tl.load(voxel + i, mask=inside, other=0).to(tl.int64)
    r = tl.load(ray + i, mask=inside, other=0).to(tl.int64)
    share = tl.load(basis + r[:, None] * BASIS + (column // 3)[None, :], mask=there, other=0.0)
    share *= tl.load(slope + 3 * i[:, None] + (column % 3)[None, :], mask=there, other=0.0)
    place = target + v[:, None] * (3 * SIZE) + column[None, :]
    tl.atomic_add(place, share, mask=there, sem="relaxed")

"""Hash-grid encoding with Triton: a program encodes a block of samples at one level, a tile
[samples, features], so that a lane loads and adds the features of an entry together.

Programs of one level are numbered consecutively, so that those running at the same time mostly read
one level, which stays in the L2 cache. The backward pass scatters with atomics, whose order is not
repeatable.
"""

from functools import cache

import torch
import triton
import triton.language as tl
from torch import Tensor

from methods.kernels.encode import PRIMES, HashGrid
from methods.kernels.gpu import check_float32, launch, vector

BLOCK = tl.constexpr(256)  # samples
MARKS_NAN = True
"""`encode` itself makes the features of a position with a NaN NaN, and gives it no gradient."""
PRIME_Y, PRIME_Z = tl.constexpr(PRIMES[1]), tl.constexpr(PRIMES[2])


def encode(positions: Tensor, table: Tensor, grid: HashGrid, packed: Tensor | None) -> Tensor:
    if positions.requires_grad:
        raise ValueError("backend 'gpu' gives no gradient for positions: use backend='reference'")
    check_float32(positions=positions, table=table)
    return _TritonEncode.apply(positions.contiguous(), table, grid, packed)


class _TritonEncode(torch.autograd.Function):
    @staticmethod
    def forward(ctx, positions, table, grid, packed):
        ctx.save_for_backward(positions)
        ctx.grid = grid
        read = table.detach() if packed is None else packed.view(torch.bfloat16).view(-1, 2)
        features = read.new_empty(len(positions), grid.channels)
        _launch(_forward, positions, read.contiguous(), grid, features)
        return features

    @staticmethod
    def backward(ctx, grad):
        (positions,) = ctx.saved_tensors
        return None, table_gradient(positions, grad, ctx.grid), None, None


def table_gradient(
    positions: Tensor, grad: Tensor, grid: HashGrid, to: Tensor | None = None
) -> Tensor:
    """The gradient [entries, F] float32 of a table, by the gradient `grad` [N, levels * F] of the
    features at `positions` [N, 3]; added `to` one, if that is given."""
    target = torch.zeros(grid.entries, grid.features, device=grad.device) if to is None else to
    _launch(_scatter, positions, target, grid, grad.contiguous())
    return target


def _launch(
    kernel: triton.JITFunction, positions: Tensor, table: Tensor, grid: HashGrid, features: Tensor
) -> None:
    """Run `kernel`, which reads one of `table` and `features` and writes to the other."""
    given = positions, table, *_level_arrays(grid, positions.device), features
    programs = triton.cdiv(len(positions), BLOCK.value), grid.levels
    launch(kernel, programs, *given, *features.shape, FEATURES=grid.features)


@cache
def _level_arrays(grid: HashGrid, device: torch.device) -> tuple[Tensor, Tensor]:
    """Scales [levels]; vertices along an axis (0: hashed), first entry, entries: [levels, 3].
    Cached, because each copy to the device would synchronise."""
    shapes = list(zip(grid.strides, grid.offsets, grid.sizes, strict=False))
    scales = torch.tensor(grid.scales, dtype=torch.float32, device=device)
    return scales, torch.tensor(shapes, dtype=torch.int64, device=device)


@triton.jit
def _axis(x, scale):
    """Cell and fraction along an axis; NaN counts as 0."""
    p = tl.minimum(tl.where(x > 0, x, 0.0), 1.0) * scale + 0.5
    cell = p.to(tl.int32)
    return cell.to(tl.uint32), p - cell.to(tl.float32)


@triton.jit
def _entry(x, y, z, stride, size):
    """Table entry, within its level, of a vertex; `stride` is 0 for a hashed level."""
    stored = x + stride * (y + stride * z)
    stored = tl.where(stored >= size, stored - size, stored)
    hashed = (x ^ (y * PRIME_Y) ^ (z * PRIME_Z)) & (size - 1)
    return tl.where(stride > 0, stored, hashed)


@triton.jit
def _corner(ix, iy, iz, fx, fy, fz, stride, size, corner: tl.constexpr):
    """Table entry, within its level, and weight of one of the eight corners of a cell."""
    bx, by, bz = corner & 1, corner >> 1 & 1, corner >> 2
    wx, wy = fx if bx else 1 - fx, fy if by else 1 - fy
    wz = fz if bz else 1 - fz
    return _entry(ix + bx, iy + by, iz + bz, stride, size), wx * wy * wz


@triton.jit
def _locate(positions, scales, shapes, level, i, inside):
    """Cells and fractions of samples at a level, whether a sample has a NaN, and the level's row of
    `_level_arrays`."""
    scale = tl.load(scales + level)
    x, y, z = vector(positions, i, inside)
    ix, fx = _axis(x, scale)
    iy, fy = _axis(y, scale)
    iz, fz = _axis(z, scale)
    lost = (x != x) | (y != y) | (z != z)
    stride = tl.load(shapes + 3 * level).to(tl.uint32)
    first = tl.load(shapes + 3 * level + 1)
    size = tl.load(shapes + 3 * level + 2).to(tl.uint32)
    return ix, iy, iz, fx, fy, fz, lost, stride, first, size


@triton.jit
def _forward(positions, table, scales, shapes, features, total, channels, FEATURES: tl.constexpr):
    WIDTH: tl.constexpr = triton.next_power_of_2(FEATURES)
    level, feature = tl.program_id(1), tl.arange(0, WIDTH)[None, :]
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = i < total
    there = inside[:, None] & (feature < FEATURES)
    ix, iy, iz, fx, fy, fz, lost, stride, first, size = _locate(
        positions, scales, shapes, level, i, inside
    )
    blended = tl.zeros([BLOCK, WIDTH], tl.float32)
    for corner in tl.static_range(8):
        entry, weight = _corner(ix, iy, iz, fx, fy, fz, stride, size, corner)
        place = table + (first + entry)[:, None] * FEATURES + feature
        blended += weight[:, None] * tl.load(place, mask=there, other=0.0).to(tl.float32)
    blended = tl.where(lost[:, None], float("nan"), blended)
    out = features + i[:, None] * channels + level * FEATURES + feature
    tl.store(out, blended.to(features.dtype.element_ty), mask=there)


@triton.jit
def _scatter(positions, target, scales, shapes, grad, total, channels, FEATURES: tl.constexpr):
    """Adjoint of `_forward`: target[corner] += weight * grad."""
    WIDTH: tl.constexpr = triton.next_power_of_2(FEATURES)
    level, feature = tl.program_id(1), tl.arange(0, WIDTH)[None, :]
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = i < total
    ix, iy, iz, fx, fy, fz, lost, stride, first, size = _locate(
        positions, scales, shapes, level, i, inside
    )
    there = (inside & ~lost)[:, None] & (feature < FEATURES)
    of_features = grad + i[:, None] * channels + level * FEATURES + feature
    share = tl.load(of_features, mask=there, other=0.0).to(tl.float32)
    for corner in tl.static_range(8):
        entry, weight = _corner(ix, iy, iz, fx, fy, fz, stride, size, corner)
        place = target + (first + entry)[:, None] * FEATURES + feature
        tl.atomic_add(place, weight[:, None] * share, mask=there, sem="relaxed")

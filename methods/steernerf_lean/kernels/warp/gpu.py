"""Backward warping with Triton: one lane per pixel, or per channel of a pixel.

`enlarge` writes 4 bytes of depth per pixel; reads are shared within a cell and with its neighbours.
`warp` reads 4 bytes of depth per pixel and writes C values and the validity, 4 C + 4 bytes. In the
preceding picture (4 C bytes per pixel) neighbouring pixels look up the same four pixels, which come
from the cache.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from methods.kernels import warp as interface
from methods.kernels.gpu import check_types, launch

BLOCK = 1024
"""Values per program, 8 per lane: that many concurrent loads hide their latency."""

TOLERANCE = tl.constexpr(interface.TOLERANCE)


def enlarge(depth: Tensor, cells: Tensor, scale: int) -> Tensor:
    """See `methods.steernerf_lean.kernels.warp.enlarge`."""
    check_types(torch.float32, depth=depth)
    out = depth.new_empty(len(cells), scale**2)
    launch(
        _enlarge,
        (triton.cdiv(out.numel(), BLOCK),),
        depth.contiguous(),
        cells.contiguous(),
        *depth.shape,
        out,
        out.numel(),
        SCALE=scale,
        BLOCK=BLOCK,
    )
    return out


def warp(
    picture: Tensor,
    depth: Tensor,
    cells: Tensor,
    width: int,
    scale: int,
    projection: tuple[Tensor, Tensor],
) -> tuple[Tensor, Tensor]:
    """See `methods.steernerf_lean.kernels.warp.warp`."""
    check_types(torch.float32, picture=picture, depth=depth)
    matrix, offset = projection
    # Twelve numbers, copied without a wait of the host.
    to_source = torch.cat((matrix, offset[:, None]), dim=1).float()
    values, valid = depth.new_empty(*depth.shape, picture.shape[2]), torch.empty_like(depth)
    channels = triton.next_power_of_2(max(picture.shape[2], 1))
    pixels = max(BLOCK // channels, 1)
    launch(
        _warp,
        (triton.cdiv(depth.numel(), pixels),),
        picture.contiguous(),
        depth.contiguous(),
        cells.contiguous(),
        to_source.to(picture.device, non_blocking=True),
        *picture.shape,
        width,
        values,
        valid,
        depth.numel(),
        SCALE=scale,
        PIXELS=pixels,
        CHANNELS=channels,
    )
    return values, valid


@triton.jit
def _clamp(value, size):
    return tl.minimum(tl.maximum(value, 0), size - 1)


@triton.jit
def _place(cells, width, i, inside, SCALE: tl.constexpr):
    """For the i-th pixels of the cells: row and column of the cell, and of the pixel in it.

    Divisions are 32-bit or by constants, because others would cost more than all the rest.
    """
    cell = tl.load(cells + i // (SCALE * SCALE), mask=inside, other=0).to(tl.int32)
    sub = (i % (SCALE * SCALE)).to(tl.int32)
    return cell // width, cell % width, sub // SCALE, sub % SCALE


@triton.jit
def _between(cell, sub, SCALE: tl.constexpr):
    """Along one axis, the cell whose centre precedes the `sub`-th pixel of `cell`; a fraction.

    The fraction is the pixel's position on the way to the next centre. Computed in integers, in
    half pixels, so that a weight of 0 is exactly 0.
    """
    halves = 2 * sub + 1 + SCALE  # from the previous cell's centre
    return cell - 1 + halves // (2 * SCALE), (halves % (2 * SCALE)).to(tl.float32) / (2 * SCALE)


@triton.jit
def _known(depth, row, column, height, width, weight, inside):
    """Depth of a low-resolution pixel; inf if it is not finite or has no weight."""
    place = depth + _clamp(row, height) * width + _clamp(column, width)
    z = tl.load(place, mask=inside, other=float("inf"))
    return tl.where((weight > 0) & (z > float("-inf")) & (z < float("inf")), z, float("inf"))


@triton.jit
def _enlarge(depth, cells, height, width, out, total, SCALE: tl.constexpr, BLOCK: tl.constexpr):
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = i < total
    row, column, sub_row, sub_column = _place(cells, width, i, inside, SCALE)
    row, down = _between(row, sub_row, SCALE)
    column, right = _between(column, sub_column, SCALE)
    w0, w1 = (1 - down) * (1 - right), (1 - down) * right
    w2, w3 = down * (1 - right), down * right
    z0 = _known(depth, row, column, height, width, w0, inside)
    z1 = _known(depth, row, column + 1, height, width, w1, inside)
    z2 = _known(depth, row + 1, column, height, width, w2, inside)
    z3 = _known(depth, row + 1, column + 1, height, width, w3, inside)
    limit = tl.minimum(tl.minimum(z0, z1), tl.minimum(z2, z3)) + TOLERANCE
    sum0, part0 = _kept(z0, w0, limit)
    sum1, part1 = _kept(z1, w1, limit)
    sum2, part2 = _kept(z2, w2, limit)
    sum3, part3 = _kept(z3, w3, limit)
    weights = part0 + part1 + part2 + part3
    mean = (sum0 + sum1 + sum2 + sum3) / tl.where(weights > 0, weights, 1.0)
    tl.store(out + i, tl.where(weights > 0, mean, float("inf")), mask=inside)


@triton.jit
def _kept(z, weight, limit):
    """(depth * weight, weight) for depths up to `limit`; 0 beyond."""
    kept = (z <= limit) & (z < float("inf"))
    return weight * tl.where(kept, z, 0.0), tl.where(kept, weight, 0.0)


@triton.jit
def _coordinate(to_source, k, u, v, z):
    """The k-th homogeneous coordinate in the source picture."""
    of = to_source + 4 * k
    return z * (tl.load(of) * u + tl.load(of + 1) * v + tl.load(of + 2)) + tl.load(of + 3)


@triton.jit
def _warp(
    picture,
    depth,
    cells,
    to_source,
    height,
    width,
    channels,
    cells_a_row,
    values,
    valid,
    total,
    SCALE: tl.constexpr,
    PIXELS: tl.constexpr,
    CHANNELS: tl.constexpr,
):
    i = tl.program_id(0).to(tl.int64) * PIXELS + tl.arange(0, PIXELS)
    inside = i < total
    row, column, sub_row, sub_column = _place(cells, cells_a_row, i, inside, SCALE)
    v = (row * SCALE + sub_row).to(tl.float32) + 0.5
    u = (column * SCALE + sub_column).to(tl.float32) + 0.5
    z = tl.load(depth + i, mask=inside, other=0.0)
    seen = (z > 0) & (z < float("inf"))
    z = tl.where(seen, z, 1.0)
    w = _coordinate(to_source, 2, u, v, z)
    seen = seen & (w > 0)
    # Correctly rounded, as on the CPU, so that a still camera sees each pixel where it was.
    x = tl.div_rn(_coordinate(to_source, 0, u, v, z), tl.where(seen, w, 1.0))
    y = tl.div_rn(_coordinate(to_source, 1, u, v, z), tl.where(seen, w, 1.0))
    seen = seen & (x >= 0) & (x < width) & (y >= 0) & (y < height)
    x, y = tl.where(seen, x, 0.5) - 0.5, tl.where(seen, y, 0.5) - 0.5
    left, top = tl.floor(x), tl.floor(y)
    right, down = (x - left)[:, None], (y - top)[:, None]
    column, row = left.to(tl.int32), top.to(tl.int32)
    channel = tl.arange(0, CHANNELS)
    there = channel[None, :] < channels
    shown = seen[:, None] & there
    p0 = _look_up(picture, row, column, height, width, channels, channel, shown)
    p1 = _look_up(picture, row, column + 1, height, width, channels, channel, shown)
    p2 = _look_up(picture, row + 1, column, height, width, channels, channel, shown)
    p3 = _look_up(picture, row + 1, column + 1, height, width, channels, channel, shown)
    above, below = (1 - right) * p0 + right * p1, (1 - right) * p2 + right * p3
    place = values + i[:, None] * channels + channel[None, :]
    tl.store(place, (1 - down) * above + down * below, mask=inside[:, None] & there)
    tl.store(valid + i, seen.to(tl.float32), mask=inside)


@triton.jit
def _look_up(picture, row, column, height, width, channels, channel, shown):
    """Values of source pixels, with a repeated border; 0 where `shown` is false."""
    pixel = _clamp(row, height).to(tl.int64) * width + _clamp(column, width)
    return tl.load(picture + pixel[:, None] * channels + channel[None, :], mask=shown, other=0.0)

"""Blending with Triton: one program per tile of 16 x 16 pixels.

A Gaussian has an entry for every tile that its box touches. Sorted by tile and depth (Kerbl et al.
2023, Section 6), the entries form the list of each tile. The host waits once, for their total
number. A program processes its list, a few Gaussians at a time, until its tile is opaque.

There are no atomics. The backward pass writes sums over the pixels of a tile to the position that
the entry had before sorting, where the entries of a Gaussian are adjacent, and adds these up. So
gradients are repeatable.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import triton
import triton.language as tl
from torch import Tensor

from methods.gaussians.kernels.projection import Ellipses
from methods.kernels import gaussian_blending as interface
from methods.kernels import gaussian_projection
from methods.kernels.dispatch import interpreted
from methods.kernels.gpu import check_types, launch, vector
from methods.kernels.types import Pixels

TILE = 16  # pixels, along both axes
BLOCK = 128  # Gaussians or entries per program that makes the lists
GAUSSIANS = 64 if interpreted() else 8
"""Gaussians that a tile blends at a time, kept in registers, one pixel per lane. The interpreter
takes as long for many as for few."""

SUMS = tl.constexpr(9)  # of an entry: see `_backward`
ROWS, SLOTS = 64 if interpreted() else 4, 8
"""Gaussians per program in `_collect`, and the entries of each that are summed at a time."""

LARGEST = tl.constexpr(interface.LARGEST_ALPHA)
LEAST = tl.constexpr(gaussian_projection.LEAST_ALPHA)


def blend(
    ellipses: Ellipses,
    opacities: Tensor,
    colours: Tensor,
    width: int,
    height: int,
    stop: float,
) -> Pixels:
    """See `methods.gaussians.kernels.blending.blend`."""
    centres, conics, depth = ellipses.centres, ellipses.conics, ellipses.depth
    given = {"centres": centres, "conics": conics, "opacities": opacities, "colours": colours}
    check_types(torch.float32, **given, depth=depth)
    return Pixels(*_Blend.apply(*given.values(), depth, ellipses.extents, width, height, stop))


class _Lists(NamedTuple):
    """Which Gaussians each tile shows.

    Attributes:
        offsets: [tiles + 1], tile t owns entries offsets[t] to offsets[t + 1].
        owners: [E] the Gaussian of each entry, nearest first in a tile.
        slots: [E] the position of each entry before sorting: Gaussian by Gaussian.
        ends: [N] end of the positions of each Gaussian, where those of the next begin.
    """

    offsets: Tensor
    owners: Tensor
    slots: Tensor
    ends: Tensor

    @classmethod
    def of(cls, centres: Tensor, depth: Tensor, extents: Tensor, size: tuple[int, int]) -> _Lists:
        """The lists for a picture of `size` (tiles across, tiles down)."""
        count, device = len(centres), centres.device
        counts = torch.zeros(count, dtype=torch.int64, device=device)
        launch(
            _count,
            (triton.cdiv(count, BLOCK),),
            *(centres, extents, *size, counts, count),
            TILE=TILE,
            BLOCK=BLOCK,
        )
        total = int(counts.sum())
        owners = torch.repeat_interleave(counts, output_size=total)
        ends = counts.cumsum(dim=0)
        keys = torch.empty(total, dtype=torch.int64, device=device)
        launch(
            _name,
            (triton.cdiv(total, BLOCK),),
            *(centres, extents, *size, depth, owners, ends - counts, keys, total),
            TILE=TILE,
            BLOCK=BLOCK,
        )
        keys, slots = keys.sort(stable=True)  # stable: keeps the order of equal depths
        tiles = torch.arange(size[0] * size[1] + 1, device=device)
        return cls(torch.searchsorted(keys, tiles << 32), owners[slots], slots, ends)


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(ctx, centres, conics, opacities, colours, depth, extents, width, height, stop):
        inputs = [x.detach().contiguous() for x in (centres, conics, opacities, colours)]
        depth = depth.contiguous()
        size = triton.cdiv(width, TILE), triton.cdiv(height, TILE)
        lists = _Lists.of(inputs[0], depth, extents.contiguous(), size)
        values = depth.new_empty(width * height, 3)
        depth_sum, alpha = (depth.new_empty(width * height) for _ in range(2))
        launch(
            _forward,
            size,
            *inputs,
            *(depth, lists.offsets, lists.owners, stop, width, height),
            *(values, depth_sum, alpha),
            TILE=TILE,
            GAUSSIANS=GAUSSIANS,
        )
        ctx.save_for_backward(*inputs, *lists, values, alpha)
        ctx.size, ctx.stop = (width, height), stop
        ctx.mark_non_differentiable(depth_sum)
        return values, depth_sum, alpha

    @staticmethod
    def backward(ctx, grad_values, _grad_depth, grad_alpha):
        *inputs, offsets, owners, slots, ends, values, alpha = ctx.saved_tensors
        width, height = ctx.size
        sums = alpha.new_zeros(len(slots), SUMS.value)
        launch(
            _backward,
            (triton.cdiv(width, TILE), triton.cdiv(height, TILE)),
            *inputs,
            *(offsets, owners, slots, ctx.stop, width, height, values, alpha),
            *(grad_values.contiguous(), grad_alpha.contiguous(), sums),
            TILE=TILE,
            GAUSSIANS=GAUSSIANS,
        )
        grads = [torch.empty_like(x) for x in inputs]
        _, conics, opacities, _ = inputs
        launch(
            _collect,
            (triton.cdiv(len(ends), ROWS),),
            *(conics, opacities, ends, sums, *grads, len(ends)),
            ROWS=ROWS,
            SLOTS=SLOTS,
            num_warps=1,
        )
        return (*grads, None, None, None, None, None)


@triton.jit
def _range(centres, extents, axis, i, inside, tiles, TILE: tl.constexpr):
    """The range of tiles [first, last) that boxes of Gaussians touch along an axis."""
    centre = tl.load(centres + 2 * i + axis, mask=inside, other=0.0)
    half = tl.load(extents + 2 * i + axis, mask=inside, other=0.0)
    reach = half * 1.0001 + 0.5  # a little larger: rounding leaves out no pixel
    # Clamped as floats, because converting huge values to integers is undefined.
    first = tl.minimum(tl.maximum((centre - reach) / TILE, 0.0), tiles)
    last = tl.minimum(tl.maximum((centre + reach) / TILE, 0.0), tiles)
    shown = half > 0
    first, last = tl.where(shown, first, 0.0), tl.where(shown, last, 0.0)
    return tl.floor(first).to(tl.int32), tl.ceil(last).to(tl.int32)


@triton.jit
def _count(centres, extents, across, down, counts, count, TILE: tl.constexpr, BLOCK: tl.constexpr):
    """How many tiles the box of each Gaussian touches."""
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = i < count
    left, right = _range(centres, extents, 0, i, inside, across, TILE)
    top, bottom = _range(centres, extents, 1, i, inside, down, TILE)
    tl.store(counts + i, (right - left).to(tl.int64) * (bottom - top), mask=inside)


@triton.jit
def _name(
    centres,
    extents,
    across,
    down,
    depth,
    owners,
    begins,
    keys,
    total,
    TILE: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Write the sort key of each entry: its tile, and in the lower half the bits of its depth.

    As integers, the bits of positive floats have the same order.
    """
    entry = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = entry < total
    i = tl.load(owners + entry, mask=inside, other=0)
    left, right = _range(centres, extents, 0, i, inside, across, TILE)
    top, _ = _range(centres, extents, 1, i, inside, down, TILE)
    place = (entry - tl.load(begins + i, mask=inside, other=0)).to(tl.int32)
    wide = tl.maximum(right - left, 1)
    tile = (top + place // wide) * across + left + place % wide
    bits = tl.load(depth + i, mask=inside, other=0.0).to(tl.int32, bitcast=True)
    tl.store(keys + entry, tile.to(tl.int64) << 32 | bits.to(tl.int64), mask=inside)


@triton.jit
def _pixels(width, height, TILE: tl.constexpr):
    """The pixels of a tile: offsets in memory, whether in the picture, coordinates of centres."""
    at = tl.arange(0, TILE * TILE)
    column, row = tl.program_id(0) * TILE + at % TILE, tl.program_id(1) * TILE + at // TILE
    inside = (column < width) & (row < height)
    return row.to(tl.int64) * width + column, inside, column + 0.5, row + 0.5


@triton.jit
def _shares(centres, conics, opacities, i, there, x, y):
    """Gaussians `i` [G, 1] at pixels [1, P]: offset from centre to pixel, and opacity [G, P].

    The opacity is given before and after its cut-offs.
    """
    u = x - tl.load(centres + 2 * i, mask=there, other=0.0)
    v = y - tl.load(centres + 2 * i + 1, mask=there, other=0.0)
    a, b, c = vector(conics, i, there)
    distance = a * u * u + 2 * b * u * v + c * v * v
    raw = tl.load(opacities + i, mask=there, other=0.0) * tl.exp(-distance / 2)
    return u, v, raw, tl.where(raw >= LEAST, tl.minimum(raw, LARGEST), 0.0)


@triton.jit
def _weights(share, light, stop):
    """Transmittance in front of each Gaussian, its weight, and the transmittance behind all."""
    behind = light[None, :] * tl.cumprod(1 - share, 0)
    before = behind / (1 - share)
    return before, tl.where(before > stop, before * share, 0.0), tl.min(behind, 0)


@triton.jit
def _forward(
    centres,
    conics,
    opacities,
    colours,
    depth,
    offsets,
    owners,
    stop,
    width,
    height,
    values,
    depth_sum,
    alpha,
    TILE: tl.constexpr,
    GAUSSIANS: tl.constexpr,
):
    pixel, inside, x, y = _pixels(width, height, TILE)
    light = tl.where(inside, 1.0, 0.0)
    red, green, blue = tl.zeros_like(light), tl.zeros_like(light), tl.zeros_like(light)
    far, covered = tl.zeros_like(light), tl.zeros_like(light)
    tile = tl.program_id(1) * tl.num_programs(0) + tl.program_id(0)
    first, end = tl.load(offsets + tile), tl.load(offsets + tile + 1)
    while (first < end) & (tl.max(light, 0) > stop):
        entry = first + tl.arange(0, GAUSSIANS)[:, None]
        there = entry < end
        i = tl.load(owners + entry, mask=there, other=0)
        _, _, _, share = _shares(centres, conics, opacities, i, there, x[None, :], y[None, :])
        _, weight, light = _weights(share, light, stop)
        r, g, b = vector(colours, i, there)
        red += tl.sum(weight * r, 0)
        green += tl.sum(weight * g, 0)
        blue += tl.sum(weight * b, 0)
        far += tl.sum(weight * tl.load(depth + i, mask=there, other=0.0), 0)
        covered += tl.sum(weight, 0)
        first += GAUSSIANS
    tl.store(values + 3 * pixel, red, mask=inside)
    tl.store(values + 3 * pixel + 1, green, mask=inside)
    tl.store(values + 3 * pixel + 2, blue, mask=inside)
    tl.store(depth_sum + pixel, far, mask=inside)
    tl.store(alpha + pixel, covered, mask=inside)


@triton.jit
def _backward(
    centres,
    conics,
    opacities,
    colours,
    offsets,
    owners,
    slots,
    stop,
    width,
    height,
    values,
    alpha,
    grad_values,
    grad_alpha,
    sums,
    TILE: tl.constexpr,
    GAUSSIANS: tl.constexpr,
):
    """With g_i = dL/dw_i: dL/dalpha_i = T_i g_i - (sum_{j > i} w_j g_j) / (1 - alpha_i).

    `sums` of each entry, with p = alpha_i dL/dalpha_i = dL/d(exponent):
    p, p x, p y, p x^2, p x y, p y^2, dL/dr, dL/dg, dL/db.
    """
    pixel, inside, x, y = _pixels(width, height, TILE)
    light = tl.where(inside, 1.0, 0.0)
    to_red, to_green, to_blue = vector(grad_values, pixel, inside)
    to_alpha = tl.load(grad_alpha + pixel, mask=inside, other=0.0)
    red, green, blue = vector(values, pixel, inside)
    rest = to_red * red + to_green * green + to_blue * blue
    rest += to_alpha * tl.load(alpha + pixel, mask=inside, other=0.0)
    tile = tl.program_id(1) * tl.num_programs(0) + tl.program_id(0)
    first, end = tl.load(offsets + tile), tl.load(offsets + tile + 1)
    while (first < end) & (tl.max(light, 0) > stop):
        entry = first + tl.arange(0, GAUSSIANS)[:, None]
        there = entry < end
        i = tl.load(owners + entry, mask=there, other=0)
        u, v, raw, share = _shares(centres, conics, opacities, i, there, x[None, :], y[None, :])
        before, weight, light = _weights(share, light, stop)
        r, g, b = vector(colours, i, there)
        gain = r * to_red[None, :] + g * to_green[None, :] + b * to_blue[None, :]
        gain += to_alpha[None, :]
        part = weight * gain
        slope = before * gain - (rest[None, :] - tl.cumsum(part, 0)) / (1 - share)
        rest -= tl.sum(part, 0)
        p = tl.where((weight > 0) & (raw < LARGEST), raw * slope, 0.0)
        slot = tl.load(slots + entry, mask=there, other=0)
        _keep(sums, slot, 0, p, there)
        _keep(sums, slot, 1, p * u, there)
        _keep(sums, slot, 2, p * v, there)
        _keep(sums, slot, 3, p * u * u, there)
        _keep(sums, slot, 4, p * u * v, there)
        _keep(sums, slot, 5, p * v * v, there)
        _keep(sums, slot, 6, weight * to_red[None, :], there)
        _keep(sums, slot, 7, weight * to_green[None, :], there)
        _keep(sums, slot, 8, weight * to_blue[None, :], there)
        first += GAUSSIANS


@triton.jit
def _keep(sums, slot, k: tl.constexpr, terms, there):
    """Sum `terms` [G, P] over pixels and store them as the k-th sums of entries `slot` [G, 1]."""
    tl.store(sums + slot * SUMS + k, tl.sum(terms, 1, keep_dims=True), mask=there)


@triton.jit
def _total(sums, first, end, k: tl.constexpr, ROWS: tl.constexpr, SLOTS: tl.constexpr):
    """The k-th sums of Gaussians over all their tiles."""
    total = tl.zeros([ROWS, SLOTS], tl.float32)
    slot = first[:, None] + tl.arange(0, SLOTS)[None, :]
    longest = tl.max(end - first, 0)
    while longest > 0:
        total += tl.load(sums + slot * SUMS + k, mask=slot < end[:, None], other=0.0)
        slot += SLOTS
        longest -= SLOTS
    return tl.sum(total, 1)


@triton.jit
def _collect(
    conics,
    opacities,
    ends,
    sums,
    grad_centres,
    grad_conics,
    grad_opacities,
    grad_colours,
    count,
    ROWS: tl.constexpr,
    SLOTS: tl.constexpr,
):
    """Compute the gradients of each Gaussian from its sums."""
    i = tl.program_id(0).to(tl.int64) * ROWS + tl.arange(0, ROWS)
    inside = i < count
    first = tl.load(ends + i - 1, mask=inside & (i > 0), other=0)
    end = tl.load(ends + i, mask=inside, other=0)
    end = tl.where(inside, end, first)
    a, b, c = vector(conics, i, inside)
    opacity = tl.load(opacities + i, mask=inside, other=0.0)
    px = _total(sums, first, end, 1, ROWS, SLOTS)
    py = _total(sums, first, end, 2, ROWS, SLOTS)
    tl.store(grad_centres + 2 * i, a * px + b * py, mask=inside)
    tl.store(grad_centres + 2 * i + 1, b * px + c * py, mask=inside)
    tl.store(grad_conics + 3 * i, -_total(sums, first, end, 3, ROWS, SLOTS) / 2, mask=inside)
    tl.store(grad_conics + 3 * i + 1, -_total(sums, first, end, 4, ROWS, SLOTS), mask=inside)
    tl.store(grad_conics + 3 * i + 2, -_total(sums, first, end, 5, ROWS, SLOTS) / 2, mask=inside)
    p = _total(sums, first, end, 0, ROWS, SLOTS) / tl.where(opacity > 0, opacity, 1.0)
    tl.store(grad_opacities + i, tl.where(opacity > 0, p, 0.0), mask=inside)
    for k in tl.static_range(3):
        total = _total(sums, first, end, 6 + k, ROWS, SLOTS)
        tl.store(grad_colours + 3 * i + k, total, mask=inside)

"""The voxel walk with Triton: one lane per ray, which goes from cell to cell and crosses all empty
space around it in one step.

As in the ray march, rays are walked twice: first to count crossings, then to write them, once their
places are known. Rendering is a single pass: a lane walks, shades, composites and writes its pixel.
"""

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.nn.functional import normalize

from bench.types import Rays
from methods.kernels.dispatch import interpreted
from methods.kernels.gpu import check_types, launch, opacity, vector
from methods.kernels.spherical import CHANNELS, spherical_harmonics
from methods.kernels.types import Extent, Pixels
from methods.kernels.voxel_walk import Crossings, Light, Voxels
from methods.kernels.voxel_walk.reference import clip, length, slopes

BLOCK = 1024 if interpreted() else 32
"""Rays per program: one warp, which waits for its longest ray. The interpreter takes as long for
many as for few."""

BASIS = tl.constexpr(CHANNELS)


def walk(rays: Rays, voxels: Voxels, start: Tensor, limit: int) -> Crossings:
    """See `methods.kernels.voxel_walk.walk`."""
    check_types(torch.float32, start=start)
    given, count = [*_arguments(rays, voxels, start), limit], len(start)
    counts = torch.zeros(count, dtype=torch.int64, device=start.device)
    resume = torch.full_like(start, torch.inf, memory_format=torch.contiguous_format)
    _launch(_walk, *given, counts, resume, *(None,) * 7)
    (extent,) = Extent.of_each(counts[None])
    offsets = torch.cat((counts.new_zeros(1), counts.cumsum(dim=0)))
    t, delta, near, far = (resume.new_empty(extent.total) for _ in range(4))
    ray, voxel = (torch.empty_like(t, dtype=torch.int32) for _ in range(2))
    _launch(_walk, *given, counts, resume, offsets, t, delta, near, far, ray, voxel)
    return Crossings(t, delta, offsets, near, far, ray, voxel, resume, longest=extent.longest)


def render_voxels(
    rays: Rays, voxels: Voxels, light: Light, stop: float, faint: float
) -> tuple[Pixels, Tensor, Tensor]:
    """See `methods.kernels.voxel_walk.render_voxels`."""
    check_types(torch.float32, density=light.density, harmonics=light.harmonics)
    count, device = len(rays.origins), rays.origins.device
    pixels = Pixels.blank(count, 3, device)
    crossed, shaded = (torch.zeros(count, dtype=torch.int32, device=device) for _ in range(2))
    given = _arguments(rays, voxels, torch.zeros_like(rays.origins[:, 0]))
    basis = spherical_harmonics(normalize(rays.directions.detach(), dim=1), backend="gpu")
    seen = (x.detach().contiguous() for x in (light.density, light.harmonics))
    out = pixels.values, pixels.depth_sum, pixels.alpha, crossed, shaded
    _launch(_render, *given, basis, *seen, stop, faint, *out, SIZE=light.harmonics.shape[1])
    return pixels, crossed, shaded


def _arguments(rays: Rays, voxels: Voxels, start: Tensor) -> list[Any]:
    """The arguments of the kernels for R rays and the grid; the first is the number of rays."""
    check_types(torch.float32, origins=rays.origins, directions=rays.directions)
    near, far, _ = clip(rays, voxels.resolution, start)
    lengths = length(rays.directions)
    given = rays.origins, rays.directions, slopes(rays.directions), near, far, lengths
    maps = voxels.bricks, voxels.masks, voxels.clearance, voxels.leaves
    return [
        len(near),
        *(x.detach().contiguous() for x in (*given, *maps)),
        voxels.resolution,
        1 / voxels.resolution,
    ]


def _launch(kernel: triton.JITFunction, count: int, *given: Any, **options: int) -> None:
    """Run `kernel` for `count` rays."""
    grid = (triton.cdiv(count, BLOCK),)
    launch(kernel, grid, *given, count, BLOCK=BLOCK, num_warps=1, **options)


@triton.jit
def _plane(k, width, origin, slope):
    """t at which rays cross plane `k` of an axis."""
    return (k.to(tl.float32) * width - origin) * slope


@triton.jit
def _cell(t, origin, direction, slope, size, width, going):
    """The cell of an axis in which rays are at `t`: behind the last plane that they crossed."""
    cell = ((origin + t * direction) * size.to(tl.float32)).to(tl.int32)
    cell = tl.minimum(tl.maximum(cell, 0), size - 1)
    up = (slope > 0).to(tl.int32)
    on = going & (slope != 0)
    while tl.max(on.to(tl.int32), 0) > 0:
        following = cell + 2 * up - 1
        on = on & (following >= 0) & (following < size)
        on = on & (_plane(cell + up, width, origin, slope) <= t)
        cell = tl.where(on, following, cell)
    on = going & (slope != 0)
    while tl.max(on.to(tl.int32), 0) > 0:
        before = cell - 2 * up + 1
        on = on & (before >= 0) & (before < size)
        on = on & (_plane(cell + 1 - up, width, origin, slope) > t)
        cell = tl.where(on, before, cell)
    return cell


@triton.jit
def _leave(cell, free, origin, slope, size, width):
    """t at which rays leave, along one axis, the cells known to be empty around `cell`.

    These are the cell itself or, if `free` is not 0, the cells within that clearance in bricks.
    """
    brick = cell >> 3
    first = tl.where(free == 0, cell, tl.maximum(brick - free + 1, 0) << 3)
    end = tl.where(free == 0, cell + 1, tl.minimum((brick + free) << 3, size))
    t = _plane(tl.where(slope > 0, end, first), width, origin, slope)
    return tl.where(slope != 0, t, float("inf"))


@triton.jit
def _next(cell, leave, t, far_off, origin, direction, slope, size, width):
    """The cell of an axis that is entered at `t`.

    It is a neighbour if the plane at `leave` is crossed there, otherwise the same cell; it is found
    from `t` if rays went `far_off`.
    """
    step = tl.where(slope > 0, 1, -1)
    following = tl.where(leave <= t, cell + step, cell)
    if tl.max(far_off.to(tl.int32), 0) > 0:
        there = _cell(t, origin, direction, slope, size, width, far_off)
        following = tl.where(far_off, there, following)
    return following


@triton.jit
def _rays(origins, directions, slopes, nearest, farthest, lengths, ray, count):
    """Rays, their range of t, whether it is not empty, and the lengths of directions."""
    inside = ray < count
    t = tl.load(nearest + ray, mask=inside, other=0.0)
    far = tl.load(farthest + ray, mask=inside, other=0.0)
    going = t < far
    reach = tl.load(lengths + ray, mask=inside, other=0.0)
    o, d, s = (
        vector(origins, ray, going),
        vector(directions, ray, going),
        vector(slopes, ray, going),
    )
    return o, d, s, t, far, reach, going


@triton.jit
def _cells(o, d, s, t, size, width, going):
    return (
        _cell(t, o[0], d[0], s[0], size, width, going),
        _cell(t, o[1], d[1], s[1], size, width, going),
        _cell(t, o[2], d[2], s[2], size, width, going),
    )


@triton.jit
def _step(o, d, s, bricks, masks, clearance, x, y, z, t, far, going, size, width):
    """One step: the t at which rays leave the cell or the empty space around it.

    Also whether the cell was a voxel crossed with positive length, its place in the leaves, and the
    next cell.
    """
    side = size // 8
    brick = ((x >> 3) * side + (y >> 3)) * side + (z >> 3)
    free = tl.load(clearance + brick, mask=going, other=0).to(tl.int32)
    near = going & (free == 0)
    row = tl.load(bricks + brick, mask=near, other=0).to(tl.int64)
    cell = ((y & 7) << 3) + (z & 7)
    word = tl.load(masks + row * 8 + (x & 7), mask=near, other=0)
    leave_x = _leave(x, free, o[0], s[0], size, width)
    leave_y = _leave(y, free, o[1], s[1], size, width)
    leave_z = _leave(z, free, o[2], s[2], size, width)
    leave = tl.where(going, tl.minimum(leave_x, tl.minimum(leave_y, leave_z)), t)
    hit = near & ((word >> cell.to(tl.int64) & 1) == 1) & (leave > t)
    place = row * 512 + (((x & 7) << 6) + cell)
    far_off = going & (free > 0) & (leave < far)
    x = _next(x, leave_x, leave, far_off, o[0], d[0], s[0], size, width)
    y = _next(y, leave_y, leave, far_off, o[1], d[1], s[1], size, width)
    z = _next(z, leave_z, leave, far_off, o[2], d[2], s[2], size, width)
    return leave, hit, place, x, y, z


@triton.jit
def _walk(
    origins,
    directions,
    slopes,
    nearest,
    farthest,
    lengths,
    bricks,
    masks,
    clearance,
    leaves,
    size,
    width,
    limit,
    counts,
    resume,
    offsets,
    out_t,
    out_delta,
    out_near,
    out_far,
    out_ray,
    out_voxel,
    rays,
    BLOCK: tl.constexpr,
):
    """Count crossings and find where to resume; with `offsets`, write the crossings."""
    ray = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    given = origins, directions, slopes, nearest, farthest, lengths
    o, d, s, t, far, reach, going = _rays(*given, ray, rays)
    x, y, z = _cells(o, d, s, t, size, width, going)
    inside = ray < rays
    count = tl.zeros([BLOCK], tl.int64)
    again = tl.full([BLOCK], float("inf"), tl.float32)
    begin = count if offsets is None else tl.load(offsets + ray, mask=inside, other=0)
    while tl.max(going.to(tl.int32), 0) > 0:
        leave, hit, place, x, y, z = _step(
            o, d, s, bricks, masks, clearance, x, y, z, t, far, going, size, width
        )
        if offsets is not None:
            i = begin + count
            tl.store(out_t + i, (t + leave) * 0.5, mask=hit)
            tl.store(out_delta + i, (leave - t) * reach, mask=hit)
            tl.store(out_near + i, t, mask=hit)
            tl.store(out_far + i, leave, mask=hit)
            tl.store(out_ray + i, ray.to(tl.int32), mask=hit)
            tl.store(out_voxel + i, tl.load(leaves + place, mask=hit, other=0), mask=hit)
        count += hit.to(tl.int64)
        full = hit & (count == limit)
        again = tl.where(full & (leave < far), leave, again)
        t = leave
        going = going & (t < far) & (full == 0)
    if offsets is None:
        tl.store(counts + ray, count, mask=inside)
        tl.store(resume + ray, again, mask=inside)


@triton.jit
def _render(
    origins,
    directions,
    slopes,
    nearest,
    farthest,
    lengths,
    bricks,
    masks,
    clearance,
    leaves,
    size,
    width,
    basis,
    density,
    harmonics,
    stop,
    faint,
    values,
    depth_sum,
    alpha,
    crossed,
    shaded,
    rays,
    SIZE: tl.constexpr,
    BLOCK: tl.constexpr,
):
    ray = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    given = origins, directions, slopes, nearest, farthest, lengths
    o, d, s, t, far, reach, going = _rays(*given, ray, rays)
    x, y, z = _cells(o, d, s, t, size, width, going)
    light, covered = tl.full([BLOCK], 1.0, tl.float32), tl.zeros([BLOCK], tl.float32)
    red, green, blue, depth = tl.zeros_like(t), tl.zeros_like(t), tl.zeros_like(t), covered
    steps, colours = tl.zeros([BLOCK], tl.int32), tl.zeros([BLOCK], tl.int32)
    while tl.max(going.to(tl.int32), 0) > 0:
        leave, hit, place, x, y, z = _step(
            o, d, s, bricks, masks, clearance, x, y, z, t, far, going, size, width
        )
        voxel = tl.load(leaves + place, mask=hit, other=0).to(tl.int64)
        tau = tl.load(density + voxel, mask=hit, other=0.0) * ((leave - t) * reach)
        weight = light * opacity(tau)
        covered += weight
        depth += weight * ((t + leave) * 0.5)
        steps += hit.to(tl.int32)
        seen = hit & (weight > faint)
        if tl.max(seen.to(tl.int32), 0) > 0:
            of_red, of_green, of_blue = tl.zeros_like(t), tl.zeros_like(t), tl.zeros_like(t)
            for k in tl.static_range(SIZE):
                share = tl.load(basis + ray * BASIS + k, mask=seen, other=0.0)
                r, g, b = vector(harmonics, voxel * SIZE + k, seen)
                of_red += share * r
                of_green += share * g
                of_blue += share * b
            shown = tl.where(seen, weight, 0.0)
            red += shown * tl.sigmoid(of_red)
            green += shown * tl.sigmoid(of_green)
            blue += shown * tl.sigmoid(of_blue)
            colours += seen.to(tl.int32)
        light *= tl.exp(-tau)
        t = leave
        going = going & (t < far) & (light > stop)
    inside = ray < rays
    tl.store(values + 3 * ray, red, mask=inside)
    tl.store(values + 3 * ray + 1, green, mask=inside)
    tl.store(values + 3 * ray + 2, blue, mask=inside)
    tl.store(depth_sum + ray, depth, mask=inside)
    tl.store(alpha + ray, covered, mask=inside)
    tl.store(crossed + ray, steps, mask=inside)
    tl.store(shaded + ray, colours, mask=inside)

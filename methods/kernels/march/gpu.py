"""Ray marching with Triton: one lane per ray, which crosses all empty space around it in one step.

Rays are marched twice: first to count samples, then to write them, once their places are known.
"""

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from methods.kernels.dispatch import interpreted
from methods.kernels.gpu import check_types, launch, vector
from methods.kernels.march import Segments
from methods.kernels.march.reference import clip, slopes
from methods.kernels.types import BRICK, Extent, Occupancy, Samples, offsets_of

BLOCK = 128 if interpreted() else 32
"""Rays per program: one warp, which waits for its longest ray. The interpreter takes as long for
many as for few."""


def count(segments: Segments, occupancy: Occupancy) -> Tensor:
    """How many samples a ray has, [R] int64."""
    counts, _ = _counted(_arguments(segments, occupancy))
    return counts


def march(segments: Segments, occupancy: Occupancy, extent: Extent | None) -> Samples:
    arguments = _arguments(segments, occupancy)
    counts, resume = _counted(arguments)
    if extent is None:
        (extent,) = Extent.of_each(counts[None])
    device, total = counts.device, extent.total
    offsets = offsets_of(counts)
    ray = torch.empty(total, dtype=torch.int32, device=device)
    t, positions = (torch.empty(*shape, device=device) for shape in ((total,), (total, 3)))
    _launch(arguments, counts, resume, offsets, ray, t, positions)
    delta = torch.full_like(t, segments.step)
    return Samples(t, delta, offsets, ray, positions, resume, longest=extent.longest)


def _arguments(segments: Segments, occupancy: Occupancy) -> list[Any]:
    """The arguments of `_march` for rays and grid; the last one is R."""
    origins, directions = segments.rays.origins, segments.rays.directions
    window, jitter = segments.window, segments.jitter
    check_types(torch.float32, origins=origins, directions=directions, window=window, jitter=jitter)
    near, far, step_t, alive = clip(segments)
    # Clamped to the cube: a window may lie outside it, beyond the range of integers.
    lowest = torch.minimum(torch.maximum(window[:, 0], near), far)
    given = (origins, directions, slopes(directions)[0], near, far, step_t, lowest, jitter)
    return [
        *(x.contiguous() for x in given),
        torch.where(alive, segments.start, -1).int(),
        occupancy.words,
        occupancy.clearance,
        occupancy.resolution // BRICK,
        segments.limit,
        len(origins),
    ]


def _counted(arguments: list[Any]) -> tuple[Tensor, Tensor]:
    """How many samples each ray has, and where it resumes, [R] each."""
    origins, rays = arguments[0], arguments[-1]
    counts = torch.zeros(rays, dtype=torch.int64, device=origins.device)
    resume = torch.full((rays,), -1, dtype=torch.int32, device=origins.device)
    _launch(arguments, counts, resume, None, None, None, None)
    return counts, resume


def _launch(arguments: list[Any], *outputs: Tensor | None) -> None:
    grid = (triton.cdiv(arguments[-1], BLOCK),)
    launch(_march, grid, *arguments, *outputs, BLOCK=BLOCK, num_warps=1)


@triton.jit
def _leave_slab(origin, slope, cell, free, width):
    """t at which a ray leaves, along one axis, the cells known to be empty around `cell`. These are
    the cell itself or, if `free` is not 0, the cells within that clearance in bricks."""
    brick = cell >> 2
    first = tl.where(free == 0, cell, (brick - free + 1) << 2)
    end = tl.where(free == 0, cell + 1, (brick + free) << 2)
    bound = tl.where(slope > 0, end, first).to(tl.float32)
    return tl.where(slope != 0, (bound * width - origin) * slope, float("inf"))


@triton.jit
def _cell(origin, direction, t, size):
    cell = ((origin + t * direction) * size.to(tl.float32)).to(tl.int32)
    return tl.minimum(tl.maximum(cell, 0), size - 1)


@triton.jit
def _march(
    origins,
    directions,
    slopes,
    nearest,
    farthest,
    steps,
    lowest,
    phases,
    starts,
    words,
    clearance,
    side,
    limit,
    rays,
    counts,
    resume,
    offsets,
    ray_of,
    out_t,
    out_positions,
    BLOCK: tl.constexpr,
):
    """Count samples and find where to resume; with `offsets`, write the samples there."""
    ray = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = ray < rays
    k = tl.load(starts + ray, mask=inside, other=-1)
    going = k >= 0
    ox, oy, oz = vector(origins, ray, going)
    dx, dy, dz = vector(directions, ray, going)
    sx, sy, sz = vector(slopes, ray, going)
    near = tl.load(nearest + ray, mask=going, other=0.0)
    far = tl.load(farthest + ray, mask=going, other=0.0)
    step = tl.load(steps + ray, mask=going, other=1.0)
    low = tl.load(lowest + ray, mask=going, other=0.0)
    phase = tl.load(phases + ray, mask=going, other=0.0)
    size = side * 4
    width = 1.0 / size.to(tl.float32)
    count = tl.zeros([BLOCK], tl.int64)
    begin = count if offsets is None else tl.load(offsets + ray, mask=inside, other=0)
    again = tl.full([BLOCK], -1, tl.int32)
    # One step less, because rounding may affect the step before.
    k = tl.where(going, tl.maximum(k, ((low - near) / step - phase).to(tl.int32) - 1), k)
    while tl.max(going.to(tl.int32), 0) > 0:
        t = near + (k.to(tl.float32) + phase) * step
        going = going & (t < far)
        t = tl.where(going, t, near)
        x, y, z = _cell(ox, dx, t, size), _cell(oy, dy, t, size), _cell(oz, dz, t, size)
        brick = ((x >> 2) * side + (y >> 2)) * side + (z >> 2)
        free = tl.load(clearance + brick, mask=going, other=0).to(tl.int32)
        word = tl.load(words + brick, mask=going & (free == 0), other=0)
        bit = ((x & 3) + ((y & 3) << 2) + ((z & 3) << 4)).to(tl.int64)
        passed = t >= low
        hit = going & passed & ((word >> bit & 1) == 1)
        if offsets is not None:
            place = begin + count
            tl.store(ray_of + place, ray.to(tl.int32), mask=hit)
            tl.store(out_t + place, t, mask=hit)
            tl.store(out_positions + 3 * place, ox + t * dx, mask=hit)
            tl.store(out_positions + 3 * place + 1, oy + t * dy, mask=hit)
            tl.store(out_positions + 3 * place + 2, oz + t * dz, mask=hit)
        count += hit.to(tl.int64)
        full = hit & (count == limit)
        again = tl.where(full, k + 1, again)
        skips = going & passed & (hit == 0)
        k += 1
        if tl.max(skips.to(tl.int32), 0) > 0:
            leave = _leave_slab(ox, sx, x, free, width)
            leave = tl.minimum(leave, _leave_slab(oy, sy, y, free, width))
            leave = tl.minimum(leave, _leave_slab(oz, sz, z, free, width))
            # Rounded down, so that the first step beyond the empty space is never skipped.
            ahead = tl.where(skips, (leave - near) / step, 0.0) - phase
            k = tl.maximum(k, ahead.to(tl.int32))
        going = going & (full == 0)
    if offsets is None:
        tl.store(counts + ray, count, mask=inside)
        tl.store(resume + ray, again, mask=inside)

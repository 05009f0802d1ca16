"""Ray marching with Triton: one lane per ray, which crosses all empty space around it in one step.

Rays are marched twice: first to count samples, then to write them, once their places are known.
"""

from typing import Any

import torch
import triton
import triton.language as tl

from methods.kernels import types
from methods.kernels.dispatch import interpreted
from methods.kernels.gpu import check_float32, launch, vector
from methods.kernels.march import LEAST_STEP, Segments, contraction
from methods.kernels.types import BRICK, Occupancy, Samples, offsets_of, total_and_longest

BLOCK = 128 if interpreted() else 32
"""Rays per program: one warp, which waits for its longest ray. The interpreter takes as long for
many as for few."""

PARALLEL, LEAST = tl.constexpr(types.PARALLEL), tl.constexpr(LEAST_STEP)
HALF = tl.constexpr(contraction.HALF)


def march(segments: Segments, occupancy: Occupancy) -> Samples:
    rays, window, jitter, start = segments.rays, segments.window, segments.jitter, segments.start
    origins, directions = rays.origins.contiguous(), rays.directions.contiguous()
    check_float32(origins=origins, directions=directions, window=window, jitter=jitter)
    count, device = len(origins), origins.device
    arguments = [
        *(origins, directions, window, *window.stride(), jitter, *jitter.stride()),
        *(start, *start.stride(), segments.step, segments.limit, count),
        *(occupancy.words, occupancy.clearance, occupancy.resolution // BRICK),
        occupancy.contracted,
    ]
    counts = torch.empty(count, dtype=torch.int64, device=device)
    resume = torch.empty(count, dtype=torch.int32, device=device)
    _launch(count, *arguments, counts, resume, *[None] * 5)
    offsets = offsets_of(counts)
    total, longest = total_and_longest(counts, offsets)
    ray = torch.empty(total, dtype=torch.int32, device=device)
    t, delta, positions = torch.empty(5 * total, device=device).split((total, total, 3 * total))
    positions = positions.view(total, 3)
    _launch(count, *arguments, None, None, offsets, ray, t, delta, positions)
    return Samples(t, delta, offsets, ray, positions, resume, longest=longest)


def _launch(rays: int, *arguments: Any) -> None:
    launch(_march, (triton.cdiv(rays, BLOCK),), *arguments, BLOCK=BLOCK, num_warps=1)


@triton.jit
def _finite(x):
    return tl.abs(x) < float("inf")  # and not NaN


@triton.jit
def _crossed(o, d):
    """Change of t per length along an axis, and the t at which a ray enters and leaves the cube
    along it: `reference.slopes` and `reference.crossed`."""
    parallel = tl.abs(d) < PARALLEL
    slope = tl.where(parallel, 0.0, tl.div_rn(1.0, tl.where(parallel, 1.0, d)))
    first, second = -o * slope, (1 - o) * slope
    outside = tl.where((o >= 0) & (o <= 1), float("-inf"), float("inf"))
    enter = tl.where(parallel, outside, tl.minimum(first, second))
    return slope, enter, tl.where(parallel, -outside, tl.maximum(first, second))


@triton.jit
def _course(ox, oy, oz, dx, dy, dz, width):
    """Middle, reach, first v, length of a step and end of rays: `contraction.Course`."""
    ox, oy, oz = ox.to(tl.float64) - 0.5, oy.to(tl.float64) - 0.5, oz.to(tl.float64) - 0.5
    dx, dy, dz = dx.to(tl.float64), dy.to(tl.float64), dz.to(tl.float64)
    square = dx * dx + dy * dy + dz * dz
    middle = -(ox * dx + oy * dy + oz * dz) / square
    ox, oy, oz = ox + middle * dx, oy + middle * dy, oz + middle * dz
    apart = tl.maximum(tl.sqrt(ox * ox + oy * oy + oz * oz), HALF)
    reach = apart / tl.sqrt(square)
    past = -middle / reach
    beyond = 2 - 1 / tl.maximum(tl.abs(past), 1.0)
    first = tl.where(past < 0, -beyond, beyond)
    first = tl.where(tl.abs(past) <= 1, past, first)
    end = middle + 2 / width.to(tl.float64) * reach
    length = (width.to(tl.float64) * apart).to(tl.float32)
    middle, reach, first = middle.to(tl.float32), reach.to(tl.float32), first.to(tl.float32)
    return middle, reach, first, length, end.to(tl.float32)


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
def _cell(place, size):
    cell = (place * size.to(tl.float32)).to(tl.int32)
    return tl.minimum(tl.maximum(cell, 0), size - 1)


@triton.jit
def _contracted(x, y, z):
    """`contraction.contract`."""
    x, y, z = (x - 0.5) * 4, (y - 0.5) * 4, (z - 0.5) * 4
    size = tl.maximum(tl.abs(x), tl.maximum(tl.abs(y), tl.abs(z)))
    inverse = tl.div_rn(1.0, tl.maximum(size, 1.0))
    shrunk = tl.where(inverse < 1, (2 - inverse) * inverse, 1.0)
    return x * shrunk * 0.25 + 0.5, y * shrunk * 0.25 + 0.5, z * shrunk * 0.25 + 0.5


@triton.jit
def _spread(v):
    """r at `v`, see `contraction`."""
    size = tl.abs(v)
    size = tl.where(size <= 1, size, tl.div_rn(1.0, tl.maximum(2 - size, 1e-6)))
    return tl.where(v < 0, -size, size)


@triton.jit
def _drawn_in(r):
    """v at `r`, see `contraction`."""
    size = tl.abs(r)
    size = tl.where(size <= 1, size, 2 - tl.div_rn(1.0, tl.maximum(size, 1.0)))
    return tl.where(r < 0, -size, size)


@triton.jit
def _room(place, cell, free, width):
    """How far `place` is, along one axis, from the end of the empty space around; see
    `_leave_slab`."""
    brick = cell >> 2
    first = tl.where(free == 0, cell, (brick - free + 1) << 2).to(tl.float32)
    end = tl.where(free == 0, cell + 1, (brick + free) << 2).to(tl.float32)
    return tl.minimum(place - first * width, end * width - place)


@triton.jit
def _steepness(px, py, pz, room):
    """How many times as far as its point a contracted place goes at most, within `room` of p; see
    `cpu._advance_contracted`."""
    size = tl.maximum(tl.abs(px - 0.5), tl.maximum(tl.abs(py - 0.5), tl.abs(pz - 0.5)))
    inverse = 2 - 4 * (size - room)
    steep = tl.where(inverse > 2 / 3, 4 / 3, (4 - 3 * inverse) * inverse)
    return tl.where(size + room < 0.25, 1.0, steep)


@triton.jit
def _march(
    origins,
    directions,
    window,
    window_row,
    window_column,
    jitter,
    jitter_row,
    starts,
    starts_row,
    step,
    limit,
    rays,
    words,
    clearance,
    side,
    contracted: tl.constexpr,
    counts,
    resume,
    offsets,
    ray_of,
    out_t,
    out_delta,
    out_positions,
    BLOCK: tl.constexpr,
):
    """Count samples and find where to resume; with `offsets`, write the samples there."""
    ray = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = ray < rays
    ox, oy, oz = vector(origins, ray, inside)
    dx, dy, dz = vector(directions, ray, inside)
    low = tl.load(window + ray * window_row, mask=inside, other=0.0)
    far = tl.load(window + ray * window_row + window_column, mask=inside, other=0.0)
    phase = tl.load(jitter + ray * jitter_row, mask=inside, other=0.0)
    k = tl.load(starts + ray * starts_row, mask=inside, other=-1)
    # What is not finite ends a ray, whose numbers are replaced; minimum and maximum may drop NaN.
    going = inside & (k >= 0) & (low == low) & (far == far) & (phase == phase)
    going = (
        going & _finite(ox) & _finite(oy) & _finite(oz) & _finite(dx) & _finite(dy) & _finite(dz)
    )
    length = dx.to(tl.float64) * dx + dy.to(tl.float64) * dy + dz.to(tl.float64) * dz
    going = going & (length > 0)
    length = tl.minimum(tl.sqrt(tl.where(going, length, 1.0)), 3e38).to(tl.float32)
    delta = tl.zeros([BLOCK], tl.float32) + step
    pace = tl.div_rn(delta, length)  # a step in t
    going = going & (pace >= LEAST) & (pace < float("inf"))
    ox, oy, oz = tl.where(going, ox, 0.0), tl.where(going, oy, 0.0), tl.where(going, oz, 0.0)
    dx, dy, dz = tl.where(going, dx, 1.0), tl.where(going, dy, 0.0), tl.where(going, dz, 0.0)
    # In contracted space, along the ray: middle, reach and first v; in a box, the slopes.
    if contracted:
        near, pace = delta * 0, delta * (1 / HALF)
        sx, sy, sz, delta, end = _course(ox, oy, oz, dx, dy, dz, pace)
        going = going & (end == end)
    else:
        sx, enter_x, leave_x = _crossed(ox, dx)
        sy, enter_y, leave_y = _crossed(oy, dy)
        sz, enter_z, leave_z = _crossed(oz, dz)
        near = tl.maximum(tl.maximum(enter_x, enter_y), tl.maximum(enter_z, 0.0))
        end = tl.minimum(leave_x, tl.minimum(leave_y, leave_z))
    far = tl.minimum(end, far)
    going = going & (near < far) & (far < float("inf"))
    k, pace = tl.where(going, k, -1), tl.where(going, pace, 1.0)
    near, far = tl.where(going, near, 0.0), tl.where(going, far, 0.0)
    phase, low = tl.where(going, phase, 0.0), tl.where(going, low, 0.0)
    ox, oy, oz = tl.where(going, ox, 0.0), tl.where(going, oy, 0.0), tl.where(going, oz, 0.0)
    sx, sy, sz = tl.where(going, sx, 0.0), tl.where(going, sy, 1.0), tl.where(going, sz, 0.0)
    # Clamped: a window may lie outside the cube, beyond the range of integers.
    low = tl.minimum(tl.maximum(low, near), far)
    size = side * 4
    width = tl.div_rn(1.0, size.to(tl.float32))
    count = tl.zeros([BLOCK], tl.int64)
    begin = count if offsets is None else tl.load(offsets + ray, mask=inside, other=0)
    again = tl.full([BLOCK], -1, tl.int32)
    # One step less, because rounding may affect the step before.
    if contracted:
        ahead = tl.div_rn(_drawn_in(tl.div_rn(low - sx, sy)) - sz, pace)
    else:
        ahead = tl.div_rn(low - near, pace)
    k = tl.where(going, tl.maximum(k, (ahead - phase).to(tl.int32) - 1), k)
    while tl.max(going.to(tl.int32), 0) > 0:
        if contracted:
            t = sx + sy * _spread(sz + (k.to(tl.float32) + phase) * pace)
        else:
            t = near + (k.to(tl.float32) + phase) * pace
        going = going & (t < far)
        t = tl.where(going, t, near)
        px, py, pz = ox + t * dx, oy + t * dy, oz + t * dz
        if contracted:
            px, py, pz = _contracted(px, py, pz)
        x, y, z = _cell(px, size), _cell(py, size), _cell(pz, size)
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
            long = delta
            if contracted:
                r = tl.div_rn(t - sx, sy)
                long *= tl.maximum(r * r, 1.0)
            tl.store(out_delta + place, long, mask=hit)
            tl.store(out_positions + 3 * place, px, mask=hit)
            tl.store(out_positions + 3 * place + 1, py, mask=hit)
            tl.store(out_positions + 3 * place + 2, pz, mask=hit)
        count += hit.to(tl.int64)
        full = hit & (count == limit)
        again = tl.where(full, k + 1, again)
        skips = going & passed & (hit == 0)
        k += 1
        if tl.max(skips.to(tl.int32), 0) > 0:
            if contracted:
                room = tl.minimum(_room(px, x, free, width), _room(py, y, free, width))
                room = tl.maximum(tl.minimum(room, _room(pz, z, free, width)), 0.0)
                speed = tl.maximum(tl.abs(dx), tl.maximum(tl.abs(dy), tl.abs(dz)))
                speed = tl.maximum(_steepness(px, py, pz, room) * speed, 1e-37)
                leave = t + tl.div_rn(room, speed)
                ahead = tl.div_rn(_drawn_in(tl.div_rn(leave - sx, sy)) - sz, pace)
            else:
                leave = _leave_slab(ox, sx, x, free, width)
                leave = tl.minimum(leave, _leave_slab(oy, sy, y, free, width))
                leave = tl.minimum(leave, _leave_slab(oz, sz, z, free, width))
                ahead = tl.div_rn(leave - near, pace)
            # Rounded down, so that the first step beyond the empty space is never skipped.
            ahead = tl.where(skips, ahead, 0.0) - phase
            k = tl.maximum(k, ahead.to(tl.int32))
        going = going & (full == 0)
    if offsets is None:
        tl.store(counts + ray, count, mask=inside)
        tl.store(resume + ray, again, mask=inside)

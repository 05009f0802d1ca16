"""Ray marching with Triton: one lane per ray, which crosses all empty space around it in one step.

Rays are marched twice: first to count samples, then to write them, once their places are known.
"""

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from methods.kernels.dispatch import interpreted
from methods.kernels.gpu import check_float32, launch, vector
from methods.kernels.march import Segments
from methods.kernels.march.contraction import Course
from methods.kernels.march.reference import clip, course_of, slopes
from methods.kernels.types import BRICK, Occupancy, Samples, offsets_of, total_and_longest

BLOCK = 128 if interpreted() else 32
"""Rays per program: one warp, which waits for its longest ray. The interpreter takes as long for
many as for few."""


def march(segments: Segments, occupancy: Occupancy) -> Samples:
    course = course_of(segments, occupancy)
    arguments = _arguments(segments, occupancy, course)
    counts, resume = _counted(arguments)
    device, (total, longest) = counts.device, total_and_longest(counts)
    offsets = offsets_of(counts)
    ray = torch.empty(total, dtype=torch.int32, device=device)
    t, positions = (torch.empty(*shape, device=device) for shape in ((total,), (total, 3)))
    _launch(arguments, counts, resume, offsets, ray, t, positions)
    delta = torch.full_like(t, segments.step) if course is None else course.lengths(ray, t)
    return Samples(t, delta, offsets, ray, positions, resume, longest=longest)


def _arguments(segments: Segments, occupancy: Occupancy, course: Course | None) -> list[Any]:
    """The arguments of `_march` for rays and grid; the last one is R."""
    origins, directions = segments.rays.origins, segments.rays.directions
    window, jitter = segments.window, segments.jitter
    check_float32(origins=origins, directions=directions, window=window, jitter=jitter)
    near, far, step_t, alive = clip(segments, course)
    # Clamped to the cube: a window may lie outside it, beyond the range of integers.
    lowest = torch.minimum(torch.maximum(window[:, 0], near), far)
    if course is None:
        along = slopes(directions)[0]
    else:
        along = torch.stack((course.middle, course.reach, course.first), dim=1)
        step_t = torch.full_like(step_t, course.width)
    given = (origins, directions, along, near, far, step_t, lowest, jitter)
    return [
        *(x.contiguous() for x in given),
        torch.where(alive, segments.start, -1).int(),
        occupancy.words,
        occupancy.clearance,
        occupancy.resolution // BRICK,
        segments.limit,
        occupancy.contracted,
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
    contracted: tl.constexpr,
    rays,
    counts,
    resume,
    offsets,
    ray_of,
    out_t,
    out_positions,
    BLOCK: tl.constexpr,
):
    """Count samples and find where to resume; with `offsets`, write the samples there. In
    `contracted` space, `slopes` are the middle, reach and first v of a `Course`."""
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
    width = tl.div_rn(1.0, size.to(tl.float32))
    count = tl.zeros([BLOCK], tl.int64)
    begin = count if offsets is None else tl.load(offsets + ray, mask=inside, other=0)
    again = tl.full([BLOCK], -1, tl.int32)
    # One step less, because rounding may affect the step before.
    if contracted:
        sy = tl.where(going, sy, 1.0)
        ahead = tl.div_rn(_drawn_in(tl.div_rn(low - sx, sy)) - sz, step)
    else:
        ahead = tl.div_rn(low - near, step)
    k = tl.where(going, tl.maximum(k, (ahead - phase).to(tl.int32) - 1), k)
    while tl.max(going.to(tl.int32), 0) > 0:
        if contracted:
            t = sx + sy * _spread(sz + (k.to(tl.float32) + phase) * step)
        else:
            t = near + (k.to(tl.float32) + phase) * step
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
                pace = tl.maximum(_steepness(px, py, pz, room) * speed, 1e-37)
                leave = t + tl.div_rn(room, pace)
                ahead = tl.div_rn(_drawn_in(tl.div_rn(leave - sx, sy)) - sz, step)
            else:
                leave = _leave_slab(ox, sx, x, free, width)
                leave = tl.minimum(leave, _leave_slab(oy, sy, y, free, width))
                leave = tl.minimum(leave, _leave_slab(oz, sz, z, free, width))
                ahead = tl.div_rn(leave - near, step)
            # Rounded down, so that the first step beyond the empty space is never skipped.
            ahead = tl.where(skips, ahead, 0.0) - phase
            k = tl.maximum(k, ahead.to(tl.int32))
        going = going & (full == 0)
    if offsets is None:
        tl.store(counts + ray, count, mask=inside)
        tl.store(resume + ray, again, mask=inside)

"""Ray marching with numba: a ray crosses all empty space around a cell or brick in one step.

Rays are marched only once. A chunk of rays writes the t of its samples into its own part of a
scratch array, whose pages cost nothing until written. Once all counts are known, the samples are
moved to their final place.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from methods.kernels.composite import Extent
from methods.kernels.cpu import f32, slope
from methods.kernels.march import Occupancy, Samples, Segments, longest_ray

CHUNK = 64  # rays
f64 = np.float64
INF = f32(np.inf)
UNIT_CUBE = np.array([[0, 0, 0], [1, 1, 1]], np.float32)


def count(segments: Segments, occupancy: Occupancy, step: float) -> Tensor:
    """How many samples a ray has, [R] int64."""
    return march(segments, occupancy, step, longest_ray(step)).offsets.diff()


def march(
    segments: Segments,
    occupancy: Occupancy,
    step: float,
    limit: int,
    extent: Extent | None = None,
) -> Samples:
    """See `methods.kernels.march.march`."""
    origins, directions = (
        x.contiguous() for x in (segments.rays.origins, segments.rays.directions)
    )
    if origins.dtype != torch.float32:
        raise ValueError(f"backend 'cpu' marches float32, got {origins.dtype}")
    rays = len(origins)
    most = min(limit, longest_ray(step))
    scratch = torch.empty(-(-rays // CHUNK) * CHUNK * most)
    counts = torch.empty(rays, dtype=torch.int64)
    resume = torch.empty(rays, dtype=torch.int32)
    _find(
        origins.numpy(),
        directions.numpy(),
        occupancy.words.numpy(),
        occupancy.clearance.numpy(),
        occupancy.bounds.numpy(),
        f32(step),
        segments.window.contiguous().numpy(),
        segments.jitter.contiguous().numpy(),
        segments.start.contiguous().numpy(),
        most,
        scratch.numpy(),
        counts.numpy(),
        resume.numpy(),
    )
    offsets = torch.zeros(rays + 1, dtype=torch.int64)
    torch.cumsum(counts, dim=0, out=offsets[1:])
    total = int(offsets[-1])
    t, positions = torch.empty(total), torch.empty(total, 3)
    ray = torch.empty(total, dtype=torch.int32)
    _place(
        origins.numpy(),
        directions.numpy(),
        scratch.numpy(),
        most,
        offsets.numpy(),
        t.numpy(),
        positions.numpy(),
        ray.numpy(),
    )
    return Samples(t, torch.full((total,), step), offsets, ray, positions, resume)


@njit(cache=True)
def _cross(origin, direction, box):
    """Where a ray enters and leaves a box (slab test); enter > leave if it misses."""
    enter, leave = f32(-np.inf), f32(np.inf)
    for axis in range(3):
        along = slope(direction[axis])
        if along == 0:
            if origin[axis] < box[0, axis] or origin[axis] > box[1, axis]:
                return f32(np.inf), f32(-np.inf)
        else:
            a = (box[0, axis] - origin[axis]) * along
            b = (box[1, axis] - origin[axis]) * along
            enter, leave = max(enter, min(a, b)), min(leave, max(a, b))
    return enter, leave


@njit(cache=True)
def _occupied(word, x, y, z):
    return (word >> ((x & 3) + ((y & 3) << 2) + ((z & 3) << 4))) & 1


@njit(cache=True)
def _cell(coordinate, size):
    return min(max(int(coordinate * f32(size)), 0), size - 1)


@njit(cache=True)
def _leave_slab(origin, slope, first, end, width):
    """t at which a ray leaves the cells [first, end) of one axis."""
    return (f32(end if slope > 0 else first) * width - origin) * slope if slope != 0 else INF


@njit(cache=True)
def _empty_cells(cell, free):
    """The cells of one axis that are known to be empty around `cell`, at a clearance of `free`."""
    if free == 0:
        return cell, cell + 1
    brick = cell >> 2
    return (brick - free + 1) << 2, (brick + free) << 2


@njit(cache=True)
def _march_ray(origin, direction, words, clearance, bounds, step, window, phase, k, limit, out):
    """Write the t of a ray's samples to `out`; return their count and the step to resume from."""
    ox, oy, oz = origin
    dx, dy, dz = direction
    length = f32(math.sqrt(f64(dx) ** 2 + f64(dy) ** 2 + f64(dz) ** 2))
    enter, leave = _cross(origin, direction, UNIT_CUBE)
    near, far = max(enter, f32(0)), min(leave, window[1])
    finite = abs(ox) + abs(oy) + abs(oz) < np.inf and 0 < length < np.inf
    if not (finite and near < far < np.inf):
        return 0, -1
    step_t, steps_per_t = step / length, length / step
    size = words.shape[0] * 4
    width = f32(1) / f32(size)
    sx, sy, sz = slope(dx), slope(dy), slope(dz)

    # Skip steps before the window and the box of occupied cells, with one step to spare for
    # rounding.
    enter, leave = _cross(origin, direction, bounds)
    if not enter <= leave:
        return 0, -1
    k = max(k, int((min(max(enter, window[0]), far) - near) * steps_per_t) - 1)
    far = min(far, leave + step_t)

    count = 0
    while True:
        t = near + (f32(k) + phase) * step_t
        if not t < far:
            return count, -1
        x, y, z = _cell(ox + t * dx, size), _cell(oy + t * dy, size), _cell(oz + t * dz, size)
        bx, by, bz = x >> 2, y >> 2, z >> 2
        free = np.int64(clearance[bx, by, bz])
        if t < window[0]:
            k += 1
        elif free == 0 and _occupied(words[bx, by, bz], x, y, z):
            out[count] = t
            count += 1
            k += 1
            if count == limit:
                return count, k
        else:
            x0, x1 = _empty_cells(x, free)
            y0, y1 = _empty_cells(y, free)
            z0, z1 = _empty_cells(z, free)
            leave = min(
                _leave_slab(ox, sx, x0, x1, width),
                _leave_slab(oy, sy, y0, y1, width),
                _leave_slab(oz, sz, z0, z1, width),
            )
            # Rounded down, so that the first step beyond the empty space is never skipped.
            k = max(k + 1, int((leave - near) * steps_per_t - phase))


@njit(cache=True, parallel=True)
def _find(
    origins,
    directions,
    words,
    clearance,
    bounds,
    step,
    window,
    jitter,
    start,
    most,
    scratch,
    counts,
    resume,
):
    rays = len(origins)
    for chunk in prange((rays + CHUNK - 1) // CHUNK):
        used = chunk * CHUNK * most
        for ray in range(chunk * CHUNK, min(rays, (chunk + 1) * CHUNK)):
            count, again = 0, -1
            if start[ray] >= 0:
                count, again = _march_ray(
                    origins[ray],
                    directions[ray],
                    words,
                    clearance,
                    bounds,
                    step,
                    window[ray],
                    jitter[ray],
                    np.int64(start[ray]),
                    most,
                    scratch[used:],
                )
            counts[ray], resume[ray] = count, again
            used += count


@njit(cache=True, parallel=True)
def _place(origins, directions, scratch, most, offsets, t, positions, ray_of):
    rays = len(origins)
    for chunk in prange((rays + CHUNK - 1) // CHUNK):
        shift = chunk * CHUNK * most - offsets[chunk * CHUNK]
        for ray in range(chunk * CHUNK, min(rays, (chunk + 1) * CHUNK)):
            for sample in range(offsets[ray], offsets[ray + 1]):
                t[sample] = scratch[sample + shift]
                ray_of[sample] = ray
                for axis in range(3):
                    positions[sample, axis] = origins[ray, axis] + t[sample] * directions[ray, axis]

"""The voxel walk with numba: from cell to cell in integers (Amanatides & Woo 1987), and over all
bricks known to be empty in one step.

As in the ray march, a chunk of rays writes its crossings into its own part of a scratch array; once
all counts are known, they are moved to their final place.
"""

import math

import numpy as np
import torch
from numba import prange

from bench.types import Rays
from methods.kernels.cpu import arrays, check_float32, f32, f64, i32, jit, slope
from methods.kernels.voxel_walk import Crossings, Voxels

CHUNK = 64  # rays
BLOCK = 1 << 12
"""Rays walked at a time; the next ones reuse memory that is then already in the cache."""

INF = f32(np.inf)


def maps_of(voxels: Voxels) -> tuple[np.ndarray, ...]:
    """What `walk_ray` looks up: bricks, masks, leaves, clearance."""
    return tuple(arrays(voxels.bricks, voxels.masks, voxels.leaves, voxels.clearance))


def walk(rays: Rays, voxels: Voxels) -> Crossings:
    check_float32(rays.origins, rays.directions)
    count, maps = len(rays.origins), maps_of(voxels)
    limit = 3 * voxels.resolution  # planes of the cube, and one cell before the first
    given = arrays(rays.origins, rays.directions)
    slots = -(-min(count, BLOCK) // CHUNK) * CHUNK * limit
    kinds = torch.float32, torch.float32, torch.int32  # of entry, exit and voxel
    scratch = tuple(torch.empty(slots, dtype=kind).numpy() for kind in kinds)
    offsets = torch.zeros(count + 1, dtype=torch.int64)
    parts = []
    for first in range(0, max(count, 1), BLOCK):
        origins, directions = (x[first : first + BLOCK] for x in given)
        counts = offsets[1:][first : first + BLOCK]
        _find(origins, directions, maps, limit, scratch, counts.numpy())
        ends = counts.cumsum(dim=0)
        total = int(ends[-1]) if len(ends) else 0
        found = [torch.empty(total) for _ in range(4)]
        found += [torch.empty(total, dtype=torch.int32) for _ in range(2)]
        _place(first, directions, scratch, limit, *arrays(counts, ends), tuple(arrays(*found)))
        parts.append(found)
    t, delta, near, far, ray, voxel = (torch.cat(column) for column in zip(*parts, strict=True))
    return Crossings(t, delta, offsets.cumsum(dim=0), near, far, ray, voxel)


@jit()
def length_of(dx, dy, dz):
    """Length of a direction."""
    return f32(math.sqrt(f64(dx) ** 2 + f64(dy) ** 2 + f64(dz) ** 2))


@jit()
def _plane(k, width, origin, slope):
    """t at which a ray crosses plane `k` of an axis."""
    return (f32(k) * width - origin) * slope


@jit()
def _slab(origin, slope, size, width):
    """The range of t in which a ray is inside the cube, along one axis."""
    if slope == 0:
        return (-INF, INF) if f32(0) <= origin <= f32(1) else (INF, -INF)
    a, b = _plane(0, width, origin, slope), _plane(size, width, origin, slope)
    return min(a, b), max(a, b)


@jit()
def _cell(t, origin, direction, slope, size, width):
    """The cell of an axis in which a ray is at `t`: the one behind the last crossed plane."""
    cell = min(max(int((origin + t * direction) * f32(size)), 0), size - 1)
    if slope > 0:
        while cell + 1 < size and _plane(cell + 1, width, origin, slope) <= t:
            cell += 1
        while cell > 0 and _plane(cell, width, origin, slope) > t:
            cell -= 1
    elif slope < 0:
        while cell > 0 and _plane(cell, width, origin, slope) <= t:
            cell -= 1
        while cell + 1 < size and _plane(cell + 1, width, origin, slope) > t:
            cell += 1
    return cell


@jit()
def _leave(first, end, width, origin, slope):
    """t at which a ray leaves the cells [first, end) of one axis."""
    if slope == 0:
        return INF
    return _plane(end if slope > 0 else first, width, origin, slope)


@jit()
def _empty_cells(cell, free, size):
    """The cells of one axis that are known to be empty around `cell`, at a clearance of `free`."""
    brick = cell >> 3
    return max(brick - free + 1, 0) << 3, min((brick + free) << 3, size)


@jit(error_model="numpy")
def walk_ray(origin, direction, maps, start, limit, out):
    """Write entry, exit and voxel of at most `limit` crossings into the three arrays of `out`;
    return their count, and the t to resume from."""
    bricks, masks, leaves, clearance = maps
    nears, fars, found = out
    size = bricks.shape[0] << 3
    width = f32(1) / f32(size)
    ox, oy, oz = origin[0], origin[1], origin[2]
    dx, dy, dz = direction[0], direction[1], direction[2]
    sx, sy, sz = slope(dx), slope(dy), slope(dz)
    ax, bx = _slab(ox, sx, size, width)
    ay, by = _slab(oy, sy, size, width)
    az, bz = _slab(oz, sz, size, width)
    t, far = max(max(ax, f32(0)), max(ay, az)), min(bx, min(by, bz))
    length = length_of(dx, dy, dz)
    finite = abs(ox) + abs(oy) + abs(oz) < INF and f32(0) < length < INF
    if not (finite and t < far < INF and start < far):
        return 0, INF
    t = max(t, start)
    # Direction of the next cell, and offset of the plane that is crossed.
    step_x, step_y, step_z = i32(sx > 0), i32(sy > 0), i32(sz > 0)
    count = 0
    x = _cell(t, ox, dx, sx, size, width)
    y = _cell(t, oy, dy, sy, size, width)
    z = _cell(t, oz, dz, sz, size, width)
    while True:
        free = np.int64(clearance[x >> 3, y >> 3, z >> 3])
        if free > 0:
            x0, x1 = _empty_cells(x, free, size)
            y0, y1 = _empty_cells(y, free, size)
            z0, z1 = _empty_cells(z, free, size)
            t = min(
                _leave(x0, x1, width, ox, sx),
                min(_leave(y0, y1, width, oy, sy), _leave(z0, z1, width, oz, sz)),
            )
            if t >= far:
                return count, INF
            x = _cell(t, ox, dx, sx, size, width)
            y = _cell(t, oy, dy, sy, size, width)
            z = _cell(t, oz, dz, sz, size, width)
            continue
        row = bricks[x >> 3, y >> 3, z >> 3]
        brick_x, brick_y, brick_z = x >> 3, y >> 3, z >> 3
        tx = _plane(x + step_x, width, ox, sx) if sx != 0 else INF
        ty = _plane(y + step_y, width, oy, sy) if sy != 0 else INF
        tz = _plane(z + step_z, width, oz, sz) if sz != 0 else INF
        while x >> 3 == brick_x and y >> 3 == brick_y and z >> 3 == brick_z:
            following = min(tx, min(ty, tz))
            cell = ((y & 7) << 3) + (z & 7)
            if (masks[row, x & 7] >> cell) & 1 and following > t:
                nears[count], fars[count] = t, following
                found[count] = leaves[row, ((x & 7) << 6) + cell]
                count += 1
                if count == limit:
                    return count, following if following < far else INF
            t = following
            if t >= far:
                return count, INF
            # All planes at this t are crossed, more than one at an edge or a corner.
            if tx <= t:
                x += 2 * step_x - 1
                tx = _plane(x + step_x, width, ox, sx)
            if ty <= t:
                y += 2 * step_y - 1
                ty = _plane(y + step_y, width, oy, sy)
            if tz <= t:
                z += 2 * step_z - 1
                tz = _plane(z + step_z, width, oz, sz)


@jit(parallel=True)
def _find(origins, directions, maps, limit, scratch, counts):
    rays = len(counts)
    nears, fars, voxels = scratch
    for chunk in prange((rays + CHUNK - 1) // CHUNK):
        used = chunk * CHUNK * limit
        for ray in range(chunk * CHUNK, min(rays, (chunk + 1) * CHUNK)):
            out = nears[used:], fars[used:], voxels[used:]
            counts[ray], _ = walk_ray(origins[ray], directions[ray], maps, f32(0), limit, out)
            used += counts[ray]


@jit(parallel=True)
def _place(first, directions, scratch, limit, counts, ends, out):
    rays = len(counts)
    nears, fars, voxels = scratch
    t, delta, near, far, ray_of, voxel = out
    for chunk in prange((rays + CHUNK - 1) // CHUNK):
        begin = chunk * CHUNK
        shift = begin * limit - (ends[begin] - counts[begin])
        for ray in range(begin, min(rays, begin + CHUNK)):
            length = length_of(directions[ray, 0], directions[ray, 1], directions[ray, 2])
            for i in range(ends[ray] - counts[ray], ends[ray]):
                enter, leave = nears[i + shift], fars[i + shift]
                near[i], far[i], voxel[i] = enter, leave, voxels[i + shift]
                t[i] = (enter + leave) * f32(0.5)
                delta[i] = (leave - enter) * length
                ray_of[i] = first + ray

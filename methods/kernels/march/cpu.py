"""Ray marching with numba: the rays of a chunk take their steps together, in vectors, and cross all
empty space around a cell or brick in one step.

Rays are marched only once. A chunk writes the t of its samples, in the order found, into its own
part of a scratch array, whose pages cost nothing until written. Once all counts are known, the
samples are moved to their final place, ray by ray.
"""

import math

import numpy as np
import torch
from numba import prange

from methods.kernels.cpu import arrays, check_float32, f32, f64, i32, jit, slope, u64
from methods.kernels.march import LEAST_STEP, Segments, longest_ray
from methods.kernels.march.contraction import BEYOND, Course
from methods.kernels.march.reference import clip, course_of
from methods.kernels.types import Occupancy, Samples, offsets_of

CHUNK = 128  # rays that are marched together; their numbers stay in the first-level cache

VECTOR = 32
"""Loops run over a multiple of so many columns, so that vectors leave none over. What they find in
columns without a ray is not read."""

INF = f32(np.inf)
ZEROS, ONES = (f32(0),) * 3, (f32(1),) * 3
LEAST = f32(LEAST_STEP)
FAR_AWAY = f32(2**30)  # a step that no ray reaches; the numbers of steps are int32

# Rows of a chunk: what is known of each ray, in float32 ...
ORIGIN, DIRECTION, SLOPE = 0, 3, 6  # three rows each
NEAR, FAR, STEP, RATE, PHASE, FIRST, T = 9, 10, 11, 12, 13, 14, 15
FLOATS = 16
MIDDLE, REACH, BEGIN = 6, 7, 8  # in contracted space, in place of the slopes: see `Course`
# ... and in int32. FREE is the clearance, or -1 in an occupied cell.
K, RAY, COUNT, CELL, FREE = 0, 1, 2, 3, 6
INTEGERS = 7


def march(segments: Segments, occupancy: Occupancy) -> Samples:
    step, origins, directions = segments.step, segments.rays.origins, segments.rays.directions
    check_float32(origins)
    rays = len(origins)
    most = min(segments.limit, longest_ray(step))
    size = -(-rays // CHUNK) * CHUNK * most
    scratch, owners = torch.empty(size), torch.empty(size, dtype=torch.uint8)
    counts = torch.empty(rays, dtype=torch.int64)
    resume = torch.empty(rays, dtype=torch.int32)
    given = arrays(origins, directions, segments.window, segments.jitter, segments.start)
    grid = arrays(occupancy.words.flatten(), occupancy.clearance.flatten(), occupancy.bounds)
    found = arrays(scratch, owners, counts, resume)
    course = course_of(segments, occupancy)
    ways, width = _ways(segments, course), f32(step if course is None else course.width)
    contracted, size = course is not None, occupancy.resolution
    _find(tuple(given), ways, tuple(grid), size, width, most, contracted, tuple(found))
    offsets = offsets_of(counts)
    total = int(offsets[-1])
    t, positions = torch.empty(total), torch.empty(total, 3)
    delta = torch.full((total,), step)
    ray = torch.empty(total, dtype=torch.int32)
    _place(*given[:2], *found[:2], most, *arrays(offsets, t, positions, ray))
    if contracted:
        _contract(*ways[:4], *arrays(t, ray, positions, delta))
    return Samples(t, delta, offsets, ray, positions, resume)


def _ways(segments: Segments, course: Course | None) -> tuple[np.ndarray, ...]:
    """What `_begin_contracted` reads of the rays; without a `course`, nothing of the same types."""
    if course is None:
        return (*[np.empty(0, np.float32)] * 5, np.empty(0, np.int32))
    _, far, _, alive = clip(segments, course)
    start = torch.where(alive, segments.start, -1).int()
    where = course.middle, course.reach, course.first, course.length, far, start
    return tuple(arrays(*where))


@jit()
def _at(row, column):
    """Place of a number of a ray, which has a column of its own in a chunk."""
    return u64(row) * u64(CHUNK) + u64(column)


@jit()
def _three(numbers, row, column):
    """Three numbers of a ray, from `row` on."""
    return numbers[_at(row, column)], numbers[_at(row + 1, column)], numbers[_at(row + 2, column)]


@jit()
def _padded(columns):
    """Columns that a loop runs over; see `VECTOR`."""
    return (columns + VECTOR - 1) // VECTOR * VECTOR


@jit()
def _load(floats, integers, origins, directions, window, jitter, start, first, rays):
    """Fill the first columns of a chunk with the rays from `first` on."""
    for i in range(rays):
        for axis in range(3):
            floats[_at(ORIGIN + axis, i)] = origins[first + i, axis]
            floats[_at(DIRECTION + axis, i)] = directions[first + i, axis]
        floats[_at(FIRST, i)], floats[_at(FAR, i)] = window[first + i]
        floats[_at(PHASE, i)] = jitter[first + i]
        integers[_at(K, i)], integers[_at(RAY, i)] = start[first + i], i


@jit(error_model="numpy")
def _cross_slab(floats, i, axis, low, high):
    """Where a ray enters and leaves a slab between two planes; enter > leave if it misses."""
    origin, along = floats[_at(ORIGIN + axis, i)], floats[_at(SLOPE + axis, i)]
    a, b = (low - origin) * along, (high - origin) * along
    enter, leave = a if a < b else b, b if a < b else a
    outside = INF if (origin < low) | (origin > high) else -INF
    return enter if along != f32(0) else outside, leave if along != f32(0) else -outside


@jit(error_model="numpy")
def _cross(floats, i, low, high):
    """Where a ray enters and leaves a box (slab test); enter > leave if it misses."""
    x, x_end = _cross_slab(floats, i, 0, low[0], high[0])
    y, y_end = _cross_slab(floats, i, 1, low[1], high[1])
    z, z_end = _cross_slab(floats, i, 2, low[2], high[2])
    return max(x, max(y, z)), min(x_end, min(y_end, z_end))


@jit()
def _whole(number):
    """A number of steps, rounded down; 0 of NaN."""
    number = number if number > f32(0) else f32(0)
    return i32(number if number < FAR_AWAY else FAR_AWAY)


@jit(error_model="numpy")
def _begin(floats, integers, rays, low, high, step):
    """Clip rays to the cube and their windows, and skip the steps in front of the box of occupied
    cells, from `low` to `high`. FREE is 1 if there is something to march."""
    for i in range(_padded(rays)):
        x, y, z = _three(floats, DIRECTION, i)
        length = f32(math.sqrt(f64(x) * f64(x) + f64(y) * f64(y) + f64(z) * f64(z)))
        step_t, rate = step / length, length / step
        floats[_at(SLOPE, i)] = slope(x)
        floats[_at(SLOPE + 1, i)] = slope(y)
        floats[_at(SLOPE + 2, i)] = slope(z)
        first = floats[_at(FIRST, i)]
        enter, leave = _cross(floats, i, ZEROS, ONES)
        near, far = max(enter, f32(0)), min(leave, floats[_at(FAR, i)])
        x, y, z = _three(floats, ORIGIN, i)
        finite = (abs(x) + abs(y) + abs(z) < INF) & (step_t >= LEAST) & (step_t < INF)
        alive = finite & (near < far) & (far < INF) & (integers[_at(K, i)] >= 0)
        enter, leave = _cross(floats, i, low, high)
        integers[_at(FREE, i)] = i32(alive & (enter <= leave))
        # With a step to spare for rounding.
        skipped = _whole((min(max(enter, first), far) - near) * rate) - 1
        integers[_at(K, i)] = max(integers[_at(K, i)], skipped)
        floats[_at(NEAR, i)] = near
        floats[_at(FAR, i)] = min(far, leave + step_t)
        floats[_at(STEP, i)] = step_t
        floats[_at(RATE, i)] = rate


@jit()
def _move(floats, integers, source, target):
    """Move a ray to another column."""
    for row in range(FLOATS):
        floats[_at(row, target)] = floats[_at(row, source)]
    for row in range(INTEGERS):
        integers[_at(row, target)] = integers[_at(row, source)]


@jit()
def _cell(coordinate, size):
    """Cell of one axis; truncating a number above -1 rounds down or to 0."""
    at = coordinate * size
    at = at if at > f32(0) else f32(0)
    last = size - f32(1)
    return i32(at if at < last else last)


@jit(error_model="numpy")
def _locate(floats, integers, rays, size):
    """t of the next step of each ray, +inf if it has left, and the cell there."""
    for i in range(_padded(rays)):
        near = floats[_at(NEAR, i)]
        k = f32(integers[_at(K, i)])
        t = near + (k + floats[_at(PHASE, i)]) * floats[_at(STEP, i)]
        inside = t < floats[_at(FAR, i)]
        at = t if inside else near
        x, y, z = _three(floats, ORIGIN, i)
        dx, dy, dz = _three(floats, DIRECTION, i)
        integers[_at(CELL, i)] = _cell(x + at * dx, size)
        integers[_at(CELL + 1, i)] = _cell(y + at * dy, size)
        integers[_at(CELL + 2, i)] = _cell(z + at * dz, size)
        floats[_at(T, i)] = t if inside else INF


@jit()
def _leave_axis(floats, integers, i, axis, free, width):
    """t at which a ray leaves, along one axis, the cells around it that are known to be empty at a
    clearance of `free` bricks; at 0 that is its own cell."""
    along, cell = floats[_at(SLOPE + axis, i)], integers[_at(CELL + axis, i)]
    ahead, brick = along > f32(0), i32(cell >> i32(2))
    next_cell = i32(cell + i32(ahead))
    next_brick = i32(brick + free) if ahead else i32(i32(brick - free) + i32(1))
    edge = f32(i32(next_brick << i32(2)) if free > 0 else next_cell)
    leave = (edge * width - floats[_at(ORIGIN + axis, i)]) * along
    return leave if along != f32(0) else INF


@jit(error_model="numpy")
def _advance(floats, integers, rays, width):
    """The next step of each ray: the one after a sample, or the last in the empty space around."""
    for i in range(_padded(rays)):
        free = integers[_at(FREE, i)]
        x = _leave_axis(floats, integers, i, 0, free, width)
        y = _leave_axis(floats, integers, i, 1, free, width)
        z = _leave_axis(floats, integers, i, 2, free, width)
        leave = x if x < y else y
        leave = leave if leave < z else z
        # Rounded down, so that the first step beyond the empty space is never skipped.
        to = (leave - floats[_at(NEAR, i)]) * floats[_at(RATE, i)]
        beyond = _whole(to - floats[_at(PHASE, i)])
        after = i32(integers[_at(K, i)] + i32(1))
        beyond = beyond if free >= 0 else after
        integers[_at(K, i)] = beyond if beyond > after else after


@jit()
def _begin_contracted(floats, integers, ways, first, rays, width):
    """As `_begin`, in contracted space: rays have their course and no end but that of a window."""
    middle, reach, begin, _, far, start = ways
    for i in range(rays):
        floats[_at(MIDDLE, i)] = middle[first + i]
        floats[_at(REACH, i)] = reach[first + i]
        floats[_at(BEGIN, i)] = begin[first + i]
        floats[_at(FAR, i)] = far[first + i]
        floats[_at(STEP, i)] = width
        floats[_at(RATE, i)] = f32(1) / width
        integers[_at(K, i)] = start[first + i]
        integers[_at(FREE, i)] = start[first + i] >= 0


@jit(error_model="numpy")
def _contracted(x, y, z):
    """`contraction.contract`."""
    x, y, z = (x - f32(0.5)) * f32(4), (y - f32(0.5)) * f32(4), (z - f32(0.5)) * f32(4)
    inverse = f32(1) / max(abs(x), max(abs(y), abs(z)))
    shrunk = (f32(2) - inverse) * inverse if inverse < f32(1) else f32(1)
    quarter, half = f32(0.25), f32(0.5)
    return x * shrunk * quarter + half, y * shrunk * quarter + half, z * shrunk * quarter + half


@jit(error_model="numpy")
def _locate_contracted(floats, integers, rays, size):
    """As `_locate`, in contracted space."""
    for i in range(_padded(rays)):
        k = f32(integers[_at(K, i)]) + floats[_at(PHASE, i)]
        v = floats[_at(BEGIN, i)] + k * floats[_at(STEP, i)]
        reach = abs(v)
        reach = reach if reach <= f32(1) else f32(1) / max(f32(2) - reach, f32(BEYOND))
        t = floats[_at(MIDDLE, i)] + floats[_at(REACH, i)] * (-reach if v < f32(0) else reach)
        inside = t < floats[_at(FAR, i)]
        at = t if inside else f32(0)
        x, y, z = _three(floats, ORIGIN, i)
        dx, dy, dz = _three(floats, DIRECTION, i)
        x, y, z = _contracted(x + at * dx, y + at * dy, z + at * dz)
        integers[_at(CELL, i)] = _cell(x, size)
        integers[_at(CELL + 1, i)] = _cell(y, size)
        integers[_at(CELL + 2, i)] = _cell(z, size)
        floats[_at(T, i)] = t if inside else INF


@jit()
def _room(place, cell, free, width):
    """How far `place` is, along one axis, from the end of the empty space around; see
    `_leave_axis`."""
    brick = i32(cell >> i32(2))
    low = i32(i32(i32(brick - free) + i32(1)) << i32(2)) if free > 0 else cell
    high = i32(i32(brick + free) << i32(2)) if free > 0 else i32(cell + i32(1))
    return min(place - f32(low) * width, f32(high) * width - place)


@jit(error_model="numpy")
def _advance_contracted(floats, integers, rays, width):
    """As `_advance`, in contracted space, where rays are bent: to leave the empty space, a place
    goes at least as far as `room`, and it goes `steep` times as far as its point at most. Beyond
    n, that is 4/n - 3/n^2, or 4/3 if n < 3/2; in the box it is 1."""
    for i in range(_padded(rays)):
        free, t = integers[_at(FREE, i)], floats[_at(T, i)]
        x, y, z = _three(floats, ORIGIN, i)
        dx, dy, dz = _three(floats, DIRECTION, i)
        x, y, z = _contracted(x + t * dx, y + t * dy, z + t * dz)
        a = _room(x, integers[_at(CELL, i)], free, width)
        b = _room(y, integers[_at(CELL + 1, i)], free, width)
        c = _room(z, integers[_at(CELL + 2, i)], free, width)
        room = min(a, min(b, c))
        room = room if room > f32(0) else f32(0)
        size = max(abs(x - f32(0.5)), max(abs(y - f32(0.5)), abs(z - f32(0.5))))
        inverse = f32(2) - f32(4) * (size - room)  # 1/n, at least
        steep = (f32(4) - f32(3) * inverse) * inverse
        steep = f32(4 / 3) if inverse > f32(2 / 3) else steep
        steep = f32(1) if size + room < f32(0.25) else steep
        leave = t + room / (steep * max(abs(dx), max(abs(dy), abs(dz))))
        r = (leave - floats[_at(MIDDLE, i)]) / floats[_at(REACH, i)]
        v = abs(r)
        v = v if v <= f32(1) else f32(2) - f32(1) / v
        to = ((-v if r < f32(0) else v) - floats[_at(BEGIN, i)]) * floats[_at(RATE, i)]
        beyond = _whole(to - floats[_at(PHASE, i)])
        after = i32(integers[_at(K, i)] + i32(1))
        beyond = beyond if free >= 0 else after
        integers[_at(K, i)] = beyond if beyond > after else after


@jit(parallel=True)
def _contract(middle, reach, begin, length, t, ray, positions, delta):
    """Contract the places of samples, and set the lengths of their steps."""
    for n in prange(len(t)):
        own = ray[n]
        x, y, z = _contracted(positions[n, 0], positions[n, 1], positions[n, 2])
        positions[n, 0], positions[n, 1], positions[n, 2] = x, y, z
        r = (t[n] - middle[own]) / reach[own]
        delta[n] = length[own] * max(r * r, f32(1))


@jit()
def _march_chunk(floats, integers, active, grid, resolution, limit, contracted, found):
    """March the rays in the first `active` columns to their ends."""
    words, clearance, _ = grid
    scratch, owners, counts, resume = found
    used = u64(0)
    side = resolution // 4
    size, width = f32(resolution), f32(1) / f32(resolution)
    while active > 0:
        if contracted:
            _locate_contracted(floats, integers, active, size)
        else:
            _locate(floats, integers, active, size)
        for i in range(active - 1, -1, -1):  # a ray that ends makes room for one seen before
            t = floats[_at(T, i)]
            ray, count = u64(integers[_at(RAY, i)]), integers[_at(COUNT, i)]
            again = -1
            if t < INF:
                x, y, z = _three(integers, CELL, i)
                brick = u64(((x >> 2) * side + (y >> 2)) * side + (z >> 2))
                bit = (words[brick] >> ((x & 3) + ((y & 3) << 2) + ((z & 3) << 4))) & 1
                integers[_at(FREE, i)] = np.int64(clearance[brick]) - bit
                scratch[used], owners[used] = t, ray
                sample = bit & (t >= floats[_at(FIRST, i)])
                used += u64(sample)
                count += sample
                integers[_at(COUNT, i)] = count
                if count < limit:
                    continue
                again = integers[_at(K, i)] + 1
            counts[ray], resume[ray] = count, again
            active -= 1
            _move(floats, integers, active, i)
        if contracted:
            _advance_contracted(floats, integers, active, width)
        else:
            _advance(floats, integers, active, width)


@jit(parallel=True)
def _find(given, ways, grid, resolution, step, most, contracted, found):
    origins, directions, window, jitter, start = given
    bounds = grid[2]
    scratch, owners, counts, resume = found
    rays = len(origins)
    for chunk in prange((rays + CHUNK - 1) // CHUNK):
        floats = np.zeros(FLOATS * CHUNK, np.float32)
        integers = np.zeros(INTEGERS * CHUNK, np.int32)
        low = bounds[0, 0], bounds[0, 1], bounds[0, 2]
        high = bounds[1, 0], bounds[1, 1], bounds[1, 2]
        first = chunk * CHUNK
        active = min(CHUNK, rays - first)
        counts[first : first + active], resume[first : first + active] = 0, -1
        _load(floats, integers, origins, directions, window, jitter, start, first, active)
        if contracted:
            _begin_contracted(floats, integers, ways, first, active, step)
        else:
            _begin(floats, integers, active, low, high, step)
        for i in range(active - 1, -1, -1):
            if not integers[_at(FREE, i)]:
                active -= 1
                _move(floats, integers, active, i)
        own = scratch[first * most :], owners[first * most :], counts[first:], resume[first:]
        _march_chunk(floats, integers, active, grid, resolution, most, contracted, own)


@jit(parallel=True)
def _place(origins, directions, scratch, owners, most, offsets, t, positions, ray_of):
    rays = len(origins)
    for chunk in prange((rays + CHUNK - 1) // CHUNK):
        first, last = chunk * CHUNK, min(rays, (chunk + 1) * CHUNK)
        next_ = offsets[first:last].copy()
        for n in range(offsets[last] - offsets[first]):
            ray = owners[first * most + n]
            sample = next_[ray]
            next_[ray] = sample + 1
            along = scratch[first * most + n]
            t[sample] = along
            ray_of[sample] = first + ray
            for axis in range(3):
                way = along * directions[first + ray, axis]
                positions[sample, axis] = origins[first + ray, axis] + way

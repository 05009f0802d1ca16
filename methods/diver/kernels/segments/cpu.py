"""Segments with numba. Pixels: a ray at a time, a few segments of it together, and nothing of them
ever leaves the first-level cache.

The hidden layer is computed for `ROWS` segments at once, because that is what the registers hold:
some lie behind the end of the ray, in vain. Segments that show wait until `BATCH` of them are
there, of any rays of a chunk, before their colours are computed together.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor
from torch.nn import functional

from bench.types import Rays
from methods.diver.kernels.segments import Corners, Layers
from methods.kernels.corner_gather.cpu import FAST, blended, eight_of
from methods.kernels.cpu import LANES, ROWS, arrays, check_float32, f32, multiply, prefetch, sigmoid
from methods.kernels.types import Pixels
from methods.kernels.voxel_walk import Crossings, Voxels
from methods.kernels.voxel_walk.cpu import maps_of, walk_ray

SEGMENTS = 256
"""Segments of a chunk whose weights are computed."""

CHUNK = 64  # rays
BATCH = 8 * ROWS
"""Segments whose colours are computed together."""

GAUSS = f32(0.5 / math.sqrt(3))
"""Distance of the two nodes of the Gauss-Legendre rule from the middle of a segment of length 1."""

f64 = np.float64


def segment_weights(rays: Rays, crossings: Crossings, voxels: Voxels) -> Tensor:
    check_float32(rays.origins, rays.directions, crossings.near)
    weights = torch.empty(len(crossings), 8)
    given = rays.origins, rays.directions, crossings.ray, crossings.near, crossings.far
    cells = voxels.coordinates, crossings.voxel
    _segment_weights(*arrays(*given, *cells), f32(voxels.resolution), weights.numpy())
    return weights


def render_segments(
    rays: Rays,
    voxels: Voxels,
    corners: Corners,
    layers: Layers,
    towards: Tensor,
    stop: float,
    faint: float,
) -> tuple[Pixels, Tensor, Tensor]:
    parts = [
        layers.hidden.T,
        layers.hidden_bias,
        *_whole_lanes(layers.density, layers.density_bias),
        layers.geometry.T,
        *_whole_lanes(layers.colour, layers.colour_bias),
    ]
    given = rays.origins, rays.directions, towards
    check_float32(*given, *parts)
    if any(size % LANES for size in layers.hidden.shape):
        raise ValueError(
            f"backend 'cpu' has layers of multiples of {LANES}, got {list(layers.hidden.shape)}: "
            "use backend='reference'"
        )
    if corners.table.dtype == torch.bfloat16:
        (words,) = arrays(corners.table.detach().contiguous().view(torch.int16))
        table = words.view(np.uint16)
    else:
        check_float32(corners.table)
        (table,) = arrays(corners.table)
    count = len(rays.origins)
    pixels = Pixels.blank(count, 3)
    crossed, shaded = (torch.zeros(count, dtype=torch.int32) for _ in range(2))
    _render(
        tuple(arrays(*given)),
        maps_of(voxels),
        (*arrays(voxels.coordinates, corners.rows), table),
        f32(voxels.resolution),
        tuple(arrays(*parts)),
        f64(f32(stop)),
        f64(f32(faint)),
        tuple(arrays(pixels.values, pixels.depth_sum, pixels.alpha)),
        tuple(arrays(crossed, shaded)),
    )
    return pixels, crossed, shaded


def _whole_lanes(weights: Tensor, bias: Tensor) -> tuple[Tensor, Tensor]:
    """A layer of fewer than `LANES` outputs with zeros for the others: [H, LANES], [LANES]."""
    idle = LANES - len(bias)
    return functional.pad(weights.T, (0, idle)), functional.pad(bias, (0, idle))


@njit(cache=True, fastmath=FAST)
def _corner_weights(x, y, z):
    """Trilinear weights of the eight corners, x varying fastest."""
    gx, gy, gz = f32(1) - x, f32(1) - y, f32(1) - z
    w00, w10, w01, w11 = gy * gz, y * gz, gy * z, y * z
    return gx * w00, x * w00, gx * w10, x * w10, gx * w01, x * w01, gx * w11, x * w11


@njit(cache=True)
def _put(weights, i, found):
    """Store the eight weights of a sample."""
    weights[i, 0], weights[i, 1], weights[i, 2], weights[i, 3] = found[0:4]
    weights[i, 4], weights[i, 5], weights[i, 6], weights[i, 7] = found[4:8]


@njit(cache=True, fastmath=FAST)
def _mean_weights(ax, ay, az, bx, by, bz):
    """A weight is a cubic along the segment, for which two Gauss-Legendre nodes are exact."""
    half = f32(0.5)
    mx, my, mz = (ax + bx) * half, (ay + by) * half, (az + bz) * half
    hx, hy, hz = (bx - ax) * GAUSS, (by - ay) * GAUSS, (bz - az) * GAUSS
    a = _corner_weights(mx - hx, my - hy, mz - hz)
    b = _corner_weights(mx + hx, my + hy, mz + hz)
    return (
        half * (a[0] + b[0]),
        half * (a[1] + b[1]),
        half * (a[2] + b[2]),
        half * (a[3] + b[3]),
        half * (a[4] + b[4]),
        half * (a[5] + b[5]),
        half * (a[6] + b[6]),
        half * (a[7] + b[7]),
    )


@njit(cache=True)
def _local(origin, direction, t, resolution, corner):
    """Local coordinate, along an axis, in the voxel that begins at `corner`."""
    place = (origin + t * direction) * resolution - f32(corner)
    return min(max(place, f32(0)), f32(1))


@njit(cache=True, fastmath=FAST, parallel=True)
def _segment_weights(origins, directions, ray, near, far, coordinates, voxel, resolution, weights):
    total = len(near)
    for chunk in prange((total + SEGMENTS - 1) // SEGMENTS):
        for i in range(chunk * SEGMENTS, min(total, (chunk + 1) * SEGMENTS)):
            r, v = ray[i], voxel[i]
            ox, oy, oz = origins[r, 0], origins[r, 1], origins[r, 2]
            dx, dy, dz = directions[r, 0], directions[r, 1], directions[r, 2]
            x, y, z = coordinates[v, 0], coordinates[v, 1], coordinates[v, 2]
            found = _mean_weights(
                _local(ox, dx, near[i], resolution, x),
                _local(oy, dy, near[i], resolution, y),
                _local(oz, dz, near[i], resolution, z),
                _local(ox, dx, far[i], resolution, x),
                _local(oy, dy, far[i], resolution, y),
                _local(oz, dz, far[i], resolution, z),
            )
            _put(weights, i, found)


@njit(cache=True)
def _layer(rows, inputs, count, weights, bias, outputs, relu):
    """`rows` rows of `count` numbers times `weights`, plus `bias`; all are flat."""
    multiply(rows, inputs, 0, count, 1, weights, len(bias), bias, outputs, 0, count, relu)


@njit(cache=True)
def _shade(count, waiting, buffers, layers, sums, first):
    """Add the colours of `count` segments to the `sums` of their rays, which begin at ray `first`.

    Args:
        waiting: what the hidden layer made of each segment, its ray and its weight.
        buffers: for the outputs of both layers.
        layers: what the directions add, geometry and its missing bias, colour and its bias.
    """
    hidden, rays, weights = waiting
    shown, raw = buffers
    towards, geometry, none, colour, colour_bias = layers
    size = len(none)
    rows = ROWS * ((count + ROWS - 1) // ROWS)  # the last ones of them are of no use
    _layer(rows, hidden, size, geometry, none, shown, False)
    for i in range(count):
        ray, at = rays[i], i * size
        for k in range(size):
            total = shown[at + k] + towards[ray, k]
            shown[at + k] = f32(0) if total < f32(0) else total
    _layer(rows, shown, size, colour, colour_bias, raw, False)
    for i in range(count):
        for channel in range(3):
            seen = f64(sigmoid(raw[i * LANES + channel]))
            sums[rays[i] - first, channel] += weights[i] * seen


@njit(cache=True, parallel=True, error_model="numpy")
def _render(given, maps, voxels, resolution, parts, stop, faint, pixels, counts):
    origins, directions, towards = given
    coordinates, corners, table = voxels
    hidden_weights, hidden_bias, density, density_bias, geometry, colour, colour_bias = parts
    values, depth_sum, alpha = pixels
    crossed, shaded = counts
    rays = len(origins)
    inputs, size = hidden_weights.shape
    none = np.zeros(size, np.float32)
    hidden_flat, density_flat = hidden_weights.reshape(-1), density.reshape(-1)
    layers = (towards, geometry.reshape(-1), none, colour.reshape(-1), colour_bias)
    for chunk in prange((rays + CHUNK - 1) // CHUNK):
        first, end = chunk * CHUNK, min(rays, (chunk + 1) * CHUNK)
        near, far = np.empty(ROWS, np.float32), np.empty(ROWS, np.float32)
        voxel = np.empty(ROWS, np.int32)
        features, hidden = np.zeros(ROWS * inputs, np.float32), np.empty(ROWS * size, np.float32)
        densities = np.empty(ROWS * LANES, np.float32)
        kept, filled = np.zeros(BATCH * size, np.float32), 0
        owners, shares = np.empty(BATCH, np.int64), np.empty(BATCH)
        waiting = kept, owners, shares
        buffers = np.empty(BATCH * size, np.float32), np.empty(BATCH * LANES, np.float32)
        sums = np.zeros((CHUNK, 3))
        for ray in range(first, end):
            ox, oy, oz = origins[ray, 0], origins[ray, 1], origins[ray, 2]
            dx, dy, dz = directions[ray, 0], directions[ray, 1], directions[ray, 2]
            depth, transmittance = 0.0, 1.0
            start, steps, colours = f32(0), 0, 0
            while start < np.inf and not transmittance <= stop:
                out = near, far, voxel
                count, start = walk_ray(origins[ray], directions[ray], maps, start, ROWS, out)
                if not count:
                    break
                # Corners and their features are asked for before any of them is waited for.
                for i in range(count):
                    prefetch(corners, voxel[i] * 8)
                for i in range(count):
                    for row in eight_of(corners, voxel[i]):
                        prefetch(table, row * inputs)
                for i in range(count):
                    v, near_t, far_t = voxel[i], near[i], far[i]
                    x, y, z = coordinates[v, 0], coordinates[v, 1], coordinates[v, 2]
                    weights = _mean_weights(
                        _local(ox, dx, near_t, resolution, x),
                        _local(oy, dy, near_t, resolution, y),
                        _local(oz, dz, near_t, resolution, z),
                        _local(ox, dx, far_t, resolution, x),
                        _local(oy, dy, far_t, resolution, y),
                        _local(oz, dz, far_t, resolution, z),
                    )
                    rows = eight_of(corners, v)
                    for k in range(inputs):
                        mean = blended(table, rows, weights, k)
                        features[i * inputs + k] = f32(0) if mean < f32(0) else mean
                _layer(ROWS, features, inputs, hidden_flat, hidden_bias, hidden, True)
                _layer(ROWS, hidden, size, density_flat, density_bias, densities, False)
                for i in range(count):
                    if transmittance <= stop:
                        break
                    steps += 1
                    sigma = densities[i * LANES]
                    if sigma <= 0:
                        continue
                    weight = transmittance * -math.expm1(-f64(sigma))
                    transmittance -= weight
                    depth += weight * f64((near[i] + far[i]) * f32(0.5))
                    if not weight <= faint:  # a NaN shows, too
                        colours += 1
                        for k in range(size):
                            kept[filled * size + k] = hidden[i * size + k]
                        owners[filled], shares[filled] = ray, weight
                        filled += 1
                        if filled == BATCH:
                            _shade(filled, waiting, buffers, layers, sums, first)
                            filled = 0
            depth_sum[ray], alpha[ray] = depth, 1 - transmittance
            crossed[ray], shaded[ray] = steps, colours
        _shade(filled, waiting, buffers, layers, sums, first)
        for ray in range(first, end):
            for channel in range(3):
                values[ray, channel] = sums[ray - first, channel]

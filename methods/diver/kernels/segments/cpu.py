"""Segments with numba. Pixels: a ray at a time, a few segments of it together, and nothing of them
ever leaves the first-level cache.

The hidden layer is computed for `ROWS` segments at once, because that is what the registers hold:
some lie behind the end of the ray, in vain. Segments that show wait until `BATCH` of them are
there, of any rays of a chunk, before their colours are computed together.
"""

import math

import numpy as np
import torch
from numba import prange
from torch import Tensor

from bench.types import Rays
from methods.diver.kernels.segments import Corners, Layers
from methods.kernels.corner_gather.cpu import FAST, blended, eight_of
from methods.kernels.cpu import (
    LANES,
    ROWS,
    arrays,
    check_float32,
    f32,
    f64,
    jit,
    multiply,
    prefetch,
    sigmoid,
    three,
    whole_lanes,
)
from methods.kernels.types import Pixels
from methods.kernels.voxel_walk import Crossings, Voxels
from methods.kernels.voxel_walk.cpu import maps_of, walk_ray

SEGMENTS = 256  # segments of a chunk whose weights are computed

CHUNK = 64  # rays
BATCH = 8 * ROWS  # segments whose colours are computed together

GAUSS = f32(0.5 / math.sqrt(3))
"""Distance of the two nodes of the Gauss-Legendre rule from the middle of a segment of length 1."""


def segment_weights(rays: Rays, crossings: Crossings, voxels: Voxels) -> Tensor:
    check_float32(rays.origins, rays.directions, crossings.near)
    weights = torch.empty(len(crossings), 8)
    segments = crossings.ray, crossings.near, crossings.far, voxels.coordinates, crossings.voxel
    given = arrays(rays.origins, rays.directions, *segments)
    _segment_weights(*given, f32(voxels.resolution), weights.numpy())
    return weights


def render_segments(
    rays: Rays, corners: Corners, layers: Layers, towards: Tensor, stop: float, faint: float
) -> tuple[Pixels, Tensor, Tensor]:
    parts = [
        layers.hidden.T,
        layers.hidden_bias,
        whole_lanes(layers.density.T),
        whole_lanes(layers.density_bias),
        layers.geometry.T,
        whole_lanes(layers.colour.T),
        whole_lanes(layers.colour_bias),
    ]
    given, table, voxels = (rays.origins, rays.directions, towards), corners.table, corners.voxels
    if table.dtype == torch.bfloat16:
        check_float32(*given, *parts)
        table = table.view(torch.uint16)
    else:
        check_float32(*given, *parts, table)
    if any(size % LANES for size in layers.hidden.shape):
        got = f"got {list(layers.hidden.shape)}: use backend='reference'"
        raise ValueError(f"backend 'cpu' has layers of multiples of {LANES}, {got}")
    pixels = Pixels.blank(len(towards), 3)
    crossed, shaded = torch.zeros(2, len(towards), dtype=torch.int32)
    _render(
        tuple(arrays(*given)),
        maps_of(voxels),
        tuple(arrays(voxels.coordinates, corners.rows, table)),
        f32(voxels.resolution),
        tuple(arrays(*parts)),
        (f64(f32(stop)), f64(f32(faint))),
        tuple(arrays(*pixels.columns, crossed, shaded)),
    )
    return pixels, crossed, shaded


@jit(fastmath=FAST)
def _corner_weights(x, y, z):
    """Trilinear weights of the eight corners, x varying fastest."""
    gx, gy, gz = f32(1) - x, f32(1) - y, f32(1) - z
    w00, w10, w01, w11 = gy * gz, y * gz, gy * z, y * z
    return gx * w00, x * w00, gx * w10, x * w10, gx * w01, x * w01, gx * w11, x * w11


@jit(fastmath=FAST)
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


@jit()
def _local(origin, direction, t, resolution, corner):
    """Local coordinate, along an axis, in the voxel that begins at `corner`."""
    place = (origin + t * direction) * resolution - f32(corner)
    return min(max(place, f32(0)), f32(1))


@jit()
def _weights_between(origin, direction, near, far, resolution, corner):
    """Mean weights in the voxel that begins at `corner`, on a ray from t = `near` to `far`."""
    (ox, oy, oz), (dx, dy, dz), (x, y, z) = origin, direction, corner
    return _mean_weights(
        _local(ox, dx, near, resolution, x),
        _local(oy, dy, near, resolution, y),
        _local(oz, dz, near, resolution, z),
        _local(ox, dx, far, resolution, x),
        _local(oy, dy, far, resolution, y),
        _local(oz, dz, far, resolution, z),
    )


@jit(fastmath=FAST, parallel=True)
def _segment_weights(origins, directions, ray, near, far, coordinates, voxel, resolution, weights):
    total = len(near)
    for chunk in prange((total + SEGMENTS - 1) // SEGMENTS):
        for i in range(chunk * SEGMENTS, min(total, (chunk + 1) * SEGMENTS)):
            origin, direction = three(origins, ray[i]), three(directions, ray[i])
            corner = three(coordinates, voxel[i])
            found = _weights_between(origin, direction, near[i], far[i], resolution, corner)
            weights[i, 0], weights[i, 1], weights[i, 2], weights[i, 3] = found[0:4]
            weights[i, 4], weights[i, 5], weights[i, 6], weights[i, 7] = found[4:8]


@jit()
def _layer(rows, inputs, count, weights, bias, outputs, relu):
    """`rows` rows of `count` numbers times `weights`, plus `bias`; all are flat."""
    multiply(rows, inputs, 0, count, 1, weights, len(bias), bias, outputs, 0, count, relu)


@jit()
def _shade(count, waiting, buffers, layers, sums, first):
    """Add the colours of `count` segments, of which hidden channels, rays and weights were
    `waiting`, to the `sums` of their rays, which begin at ray `first`."""
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


@jit(parallel=True, error_model="numpy")
def _render(given, maps, voxels, resolution, parts, bounds, out):
    origins, directions, towards = given
    coordinates, corners, table = voxels
    hidden_weights, hidden_bias, density, density_bias, geometry, colour, colour_bias = parts
    stop, faint = bounds
    values, depth_sum, alpha, crossed, shaded = out
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
            origin, direction = three(origins, ray), three(directions, ray)
            depth, transmittance = 0.0, 1.0
            start, steps, colours = f32(0), 0, 0
            while start < np.inf and not transmittance <= stop:
                room = near, far, voxel
                count, start = walk_ray(origins[ray], directions[ray], maps, start, ROWS, room)
                if not count:
                    break
                # Corners and their features are asked for before any of them is waited for.
                for i in range(count):
                    prefetch(corners, voxel[i] * 8)
                for i in range(count):
                    for row in eight_of(corners, voxel[i]):
                        prefetch(table, row * inputs)
                for i in range(count):
                    corner = three(coordinates, voxel[i])
                    weights = _weights_between(
                        origin, direction, near[i], far[i], resolution, corner
                    )
                    rows = eight_of(corners, voxel[i])
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

"""Pixels of corner features with numba: a ray at a time, a few segments of it together, and nothing
of them ever leaves the first-level cache.

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
from methods.diver.kernels.corner_rendering import Corners, Layers
from methods.kernels.corner_gather.cpu import blended, eight_of, local_coordinate, mean_weights
from methods.kernels.cpu import LANES, ROWS, f32, multiply, prefetch, sigmoid
from methods.kernels.types import Pixels
from methods.kernels.voxel_walk import Voxels
from methods.kernels.voxel_walk.cpu import walk_ray

CHUNK = 64  # rays
BATCH = 8 * ROWS
"""Segments whose colours are computed together."""

f64 = np.float64


def render_segments(
    rays: Rays,
    voxels: Voxels,
    corners: Corners,
    layers: Layers,
    towards: Tensor,
    stop: float,
    faint: float,
) -> tuple[Pixels, Tensor, Tensor]:
    """See `methods.diver.kernels.corner_rendering.render_segments`."""
    parts = [
        layers.hidden.T,
        layers.hidden_bias,
        *_whole_lanes(layers.density, layers.density_bias),
        layers.geometry.T,
        *_whole_lanes(layers.colour, layers.colour_bias),
    ]
    dtypes = {x.dtype for x in (rays.origins, rays.directions, towards, *parts)}
    table = corners.table.detach().contiguous()
    if dtypes != {torch.float32} or table.dtype not in (torch.float32, torch.bfloat16):
        raise ValueError(
            "backend 'cpu' renders float32 with a table of float32 or bfloat16, got "
            f"{dtypes} with {table.dtype}: use backend='reference'"
        )
    if any(size % LANES for size in layers.hidden.shape):
        raise ValueError(
            f"backend 'cpu' has layers of multiples of {LANES}, got {list(layers.hidden.shape)}: "
            "use backend='reference'"
        )
    if table.dtype == torch.bfloat16:
        features = table.view(torch.int16).numpy().view(np.uint16)
    else:
        features = table.numpy()
    count = len(rays.origins)
    pixels = Pixels.blank(count, 3)
    crossed, shaded = (torch.zeros(count, dtype=torch.int32) for _ in range(2))
    _render(
        rays.origins.detach().contiguous().numpy(),
        rays.directions.detach().contiguous().numpy(),
        towards.detach().contiguous().numpy(),
        *(x.numpy() for x in (voxels.bricks, voxels.masks, voxels.leaves, voxels.clearance)),
        voxels.coordinates.contiguous().numpy(),
        f32(voxels.resolution),
        corners.rows.contiguous().numpy(),
        features,
        *(x.detach().contiguous().numpy() for x in parts),
        f64(f32(stop)),
        f64(f32(faint)),
        pixels.values.numpy(),
        pixels.depth_sum.numpy(),
        pixels.alpha.numpy(),
        crossed.numpy(),
        shaded.numpy(),
    )
    return pixels, crossed, shaded


def _whole_lanes(weights: Tensor, bias: Tensor) -> tuple[Tensor, Tensor]:
    """A layer of fewer than `LANES` outputs with zeros for the others: [H, LANES], [LANES]."""
    idle = LANES - len(bias)
    return functional.pad(weights.T, (0, idle)), functional.pad(bias, (0, idle))


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
def _render(
    origins,
    directions,
    towards,
    bricks,
    masks,
    leaves,
    clearance,
    coordinates,
    resolution,
    corners,
    table,
    hidden_weights,
    hidden_bias,
    density,
    density_bias,
    geometry,
    colour,
    colour_bias,
    stop,
    faint,
    values,
    depth_sum,
    alpha,
    crossed,
    shaded,
):
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
                count, start = walk_ray(
                    origins[ray],
                    directions[ray],
                    bricks,
                    masks,
                    leaves,
                    clearance,
                    start,
                    ROWS,
                    near,
                    far,
                    voxel,
                )
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
                    weights = mean_weights(
                        local_coordinate(ox, dx, near_t, resolution, x),
                        local_coordinate(oy, dy, near_t, resolution, y),
                        local_coordinate(oz, dz, near_t, resolution, z),
                        local_coordinate(ox, dx, far_t, resolution, x),
                        local_coordinate(oy, dy, far_t, resolution, y),
                        local_coordinate(oz, dz, far_t, resolution, z),
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

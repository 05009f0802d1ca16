"""Corner features with numba: each table row is read whole, a few vectors of channels.

Forward: each thread handles a chunk of samples. Backward: each thread owns some table rows and goes
through all samples, so that no two threads add to the same number. This needs no atomics, and the
sums do not depend on the number of threads.
"""

from __future__ import annotations

from math import sqrt

import numpy as np
import torch
from numba import get_num_threads, njit, prange, types
from numba.extending import overload
from torch import Tensor

from bench.types import Rays
from methods.kernels.cpu import f32, u32
from methods.kernels.voxel_walk import Crossings, Voxels

CHUNK = 256  # samples
GAUSS = f32(0.5 / sqrt(3))
"""Distance of the two nodes of the Gauss-Legendre rule from the middle of a segment of length 1."""

# Reordering and fused multiply-adds are allowed; assuming that there is no NaN is not.
FAST = {"contract", "reassoc", "nsz", "arcp"}


def gather(
    table: Tensor,
    corners: Tensor,
    voxel: Tensor,
    weights: Tensor,
    *,
    grad_buffer: Tensor | None = None,
) -> Tensor:
    """See `methods.kernels.corner_gather.gather`. Not differentiable in `weights`."""
    if weights.requires_grad:
        raise ValueError("backend 'cpu' gives no gradient for weights: use backend='reference'")
    if table.dtype not in (torch.float32, torch.bfloat16) or weights.dtype != torch.float32:
        raise ValueError(
            f"backend 'cpu' gathers float32 or bfloat16 with weights of float32, got {table.dtype} "
            f"with {weights.dtype}: use backend='reference'"
        )
    if corners.dtype != torch.int32 or voxel.dtype != torch.int32:
        raise ValueError(
            f"backend 'cpu' takes int32 corners and voxels, got {corners.dtype}, {voxel.dtype}"
        )
    index = corners.contiguous(), voxel.contiguous(), weights.contiguous()
    if table.dtype == torch.bfloat16:
        features = torch.empty(len(voxel), table.shape[1])
        words = table.detach().contiguous().view(torch.int16).numpy().view(np.uint16)
        _gather(words, *(x.numpy() for x in index), features.numpy())
        return features
    return _Gather.apply(table, *index, grad_buffer)


class _Gather(torch.autograd.Function):
    @staticmethod
    def forward(ctx, table, corners, voxel, weights, grad_buffer):
        ctx.save_for_backward(corners, voxel, weights)
        ctx.shape, ctx.grad_buffer = table.shape, grad_buffer
        features = torch.empty(len(voxel), table.shape[1])
        _gather(
            table.detach().contiguous().numpy(),
            corners.numpy(),
            voxel.numpy(),
            weights.numpy(),
            features.numpy(),
        )
        return features

    @staticmethod
    def backward(ctx, grad):
        corners, voxel, weights = ctx.saved_tensors
        target = torch.zeros(ctx.shape) if ctx.grad_buffer is None else ctx.grad_buffer
        _scatter(
            grad.contiguous().numpy(),
            corners.numpy(),
            voxel.numpy(),
            weights.numpy(),
            target.numpy(),
            1 << (get_num_threads() - 1).bit_length(),
        )
        return target if ctx.grad_buffer is None else None, None, None, None, None


def trilinear(local: Tensor) -> Tensor:
    """See `methods.kernels.corner_gather.trilinear`."""
    return _weights(_trilinear, local)


def integral(entry: Tensor, leave: Tensor) -> Tensor:
    """See `methods.kernels.corner_gather.integral`."""
    return _weights(_integral, entry, leave)


def integral_along(rays: Rays, crossings: Crossings, voxels: Voxels) -> Tensor:
    """See `methods.kernels.corner_gather.integral_along`."""
    if not rays.origins.dtype == rays.directions.dtype == crossings.near.dtype == torch.float32:
        raise ValueError(
            f"backend 'cpu' takes float32 rays and crossings, got {rays.origins.dtype}, "
            f"{rays.directions.dtype}, {crossings.near.dtype}: use backend='reference'"
        )
    weights = torch.empty(len(crossings), 8)
    given = rays.origins, rays.directions, crossings.ray, crossings.near, crossings.far
    _integral_along(
        *(x.detach().contiguous().numpy() for x in given),
        voxels.coordinates.contiguous().numpy(),
        crossings.voxel.numpy(),
        f32(voxels.resolution),
        weights.numpy(),
    )
    return weights


def _weights(fill, *places: Tensor) -> Tensor:
    for place in places:
        if place.dtype != torch.float32 or place.requires_grad:
            raise ValueError(
                "backend 'cpu' takes float32 coordinates without gradient: use backend='reference'"
            )
    weights = torch.empty(len(places[0]), 8)
    fill(*(place.contiguous().numpy() for place in places), weights.numpy())
    return weights


@njit(cache=True)
def eight_of(values, i):
    """The eight numbers of a row; as separate variables they stay in registers."""
    return (
        values[i, 0],
        values[i, 1],
        values[i, 2],
        values[i, 3],
        values[i, 4],
        values[i, 5],
        values[i, 6],
        values[i, 7],
    )


def _as_float(number):
    """An entry of a table, float32 or the bits of a bfloat16, as float32."""
    raise TypeError("compiled code alone calls this")


@overload(_as_float, inline="always")
def _as_float_of(number):
    if number == types.uint16:
        return lambda number: u32(u32(number) << u32(16)).view(np.float32)
    return lambda number: number


@njit(cache=True, fastmath=FAST)
def blended(table, rows, weights, k):
    """Channel `k` of the sum of eight `rows` of `table` with `weights`."""
    r0, r1, r2, r3, r4, r5, r6, r7 = rows
    w0, w1, w2, w3, w4, w5, w6, w7 = weights
    return (
        w0 * _as_float(table[r0, k])
        + w1 * _as_float(table[r1, k])
        + w2 * _as_float(table[r2, k])
        + w3 * _as_float(table[r3, k])
        + w4 * _as_float(table[r4, k])
        + w5 * _as_float(table[r5, k])
        + w6 * _as_float(table[r6, k])
        + w7 * _as_float(table[r7, k])
    )


@njit(cache=True, fastmath=FAST, parallel=True)
def _gather(table, corners, voxel, weights, out):
    total, channels = out.shape
    for chunk in prange((total + CHUNK - 1) // CHUNK):
        for i in range(chunk * CHUNK, min(total, (chunk + 1) * CHUNK)):
            rows, shares = eight_of(corners, voxel[i]), eight_of(weights, i)
            for k in range(channels):
                out[i, k] = blended(table, rows, shares, k)


@njit(cache=True, fastmath=FAST, parallel=True)
def _scatter(grad, corners, voxel, weights, target, shares):
    """Adjoint of `_gather`: target[row] += weight * grad; `shares` is a power of 2."""
    total, channels = grad.shape
    for own in prange(shares):
        for i in range(total):
            v = voxel[i]
            for corner in range(8):
                row = corners[v, corner]
                if row & (shares - 1) == own:
                    w = weights[i, corner]
                    for k in range(channels):
                        target[row, k] += w * grad[i, k]


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


@njit(cache=True, fastmath=FAST, parallel=True)
def _trilinear(local, weights):
    total = len(local)
    for chunk in prange((total + CHUNK - 1) // CHUNK):
        for i in range(chunk * CHUNK, min(total, (chunk + 1) * CHUNK)):
            _put(weights, i, _corner_weights(local[i, 0], local[i, 1], local[i, 2]))


@njit(cache=True, fastmath=FAST)
def mean_weights(ax, ay, az, bx, by, bz):
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


@njit(cache=True, fastmath=FAST, parallel=True)
def _integral(entry, leave, weights):
    total = len(entry)
    for chunk in prange((total + CHUNK - 1) // CHUNK):
        for i in range(chunk * CHUNK, min(total, (chunk + 1) * CHUNK)):
            ax, ay, az = entry[i, 0], entry[i, 1], entry[i, 2]
            bx, by, bz = leave[i, 0], leave[i, 1], leave[i, 2]
            _put(weights, i, mean_weights(ax, ay, az, bx, by, bz))


@njit(cache=True)
def local_coordinate(origin, direction, t, resolution, corner):
    """Local coordinate, along an axis, in the voxel that begins at `corner`."""
    place = (origin + t * direction) * resolution - f32(corner)
    return min(max(place, f32(0)), f32(1))


@njit(cache=True, fastmath=FAST, parallel=True)
def _integral_along(origins, directions, ray, near, far, coordinates, voxel, resolution, weights):
    total = len(near)
    for chunk in prange((total + CHUNK - 1) // CHUNK):
        for i in range(chunk * CHUNK, min(total, (chunk + 1) * CHUNK)):
            r, v = ray[i], voxel[i]
            ox, oy, oz = origins[r, 0], origins[r, 1], origins[r, 2]
            dx, dy, dz = directions[r, 0], directions[r, 1], directions[r, 2]
            x, y, z = coordinates[v, 0], coordinates[v, 1], coordinates[v, 2]
            found = mean_weights(
                local_coordinate(ox, dx, near[i], resolution, x),
                local_coordinate(oy, dy, near[i], resolution, y),
                local_coordinate(oz, dz, near[i], resolution, z),
                local_coordinate(ox, dx, far[i], resolution, x),
                local_coordinate(oy, dy, far[i], resolution, y),
                local_coordinate(oz, dz, far[i], resolution, z),
            )
            _put(weights, i, found)

"""Corner features with Triton: each program handles a block of samples, with all channels.

A sample reads 8 rows of the table, which neighbours on a ray share through the cache, and writes
one. The backward pass scatters with atomics, whose order is not repeatable. If torch is set to use
deterministic algorithms, torch's sorted scatter is used instead, one corner at a time.
"""

from __future__ import annotations

from math import sqrt

import torch
import triton
import triton.language as tl
from torch import Tensor

from bench.types import Rays
from methods.kernels import corner_gather as interface
from methods.kernels.gpu import check_types, gradient, launch, vector
from methods.kernels.voxel_walk import Crossings, Voxels

BLOCK = 1024
"""Numbers per program at a time, 8 per lane."""

LANES = 128
"""Samples per program in the kernels that compute weights, one per lane."""

CORNERS = tl.constexpr(interface.CORNERS)
GAUSS = tl.constexpr(0.5 / sqrt(3))
"""Distance of the two nodes of the Gauss-Legendre rule from the middle of a segment of length 1."""


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
        raise ValueError("backend 'gpu' gives no gradient for weights: use backend='reference'")
    check_types(torch.float32, torch.bfloat16, table=table)
    check_types(torch.float32, weights=weights)
    check_types(torch.int32, corners=corners, voxel=voxel)
    if table.dtype == torch.bfloat16:
        table = table.detach()
    index = corners.contiguous(), voxel.contiguous(), weights.contiguous()
    return _Gather.apply(table, *index, grad_buffer)


class _Gather(torch.autograd.Function):
    @staticmethod
    def forward(ctx, table, corners, voxel, weights, grad_buffer):
        ctx.save_for_backward(corners, voxel, weights)
        ctx.shape, ctx.grad_buffer = table.shape, grad_buffer
        features = weights.new_empty(len(voxel), table.shape[1])
        _move(_gather, table.detach().contiguous(), corners, voxel, weights, features)
        return features

    @staticmethod
    def backward(ctx, grad):
        corners, voxel, weights = ctx.saved_tensors
        buffer = ctx.grad_buffer
        with gradient(buffer, ctx.shape, grad.device) as target:
            if torch.are_deterministic_algorithms_enabled():
                for corner in range(interface.CORNERS):
                    rows = corners[voxel.long(), corner].long()
                    target.index_put_((rows,), weights[:, corner, None] * grad, accumulate=True)
            else:
                _move(_scatter, target, corners, voxel, weights, grad.contiguous())
        return target if buffer is None else None, None, None, None, None


def trilinear(local: Tensor) -> Tensor:
    """See `methods.kernels.corner_gather.trilinear`."""
    return _weights(_trilinear, local)


def integral(entry: Tensor, leave: Tensor) -> Tensor:
    """See `methods.kernels.corner_gather.integral`."""
    return _weights(_integral, entry, leave)


def integral_along(rays: Rays, crossings: Crossings, voxels: Voxels) -> Tensor:
    """See `methods.kernels.corner_gather.integral_along`."""
    origins, directions, near = rays.origins, rays.directions, crossings.near
    check_types(torch.float32, origins=origins, directions=directions, near=near)
    of_rays = (x.detach() for x in (origins, directions))
    given = *of_rays, crossings.ray, near, crossings.far, voxels.coordinates, crossings.voxel
    return _filled(_integral_along, len(crossings), *given, SIZE=voxels.resolution)


def _weights(kernel: triton.JITFunction, *places: Tensor) -> Tensor:
    for place in places:
        check_types(torch.float32, coordinates=place)
        if place.requires_grad:
            raise ValueError(
                "backend 'gpu' gives no gradient for coordinates: use backend='reference'"
            )
    return _filled(kernel, len(places[0]), *places)


def _filled(
    kernel: triton.JITFunction, count: int, first: Tensor, *given: Tensor, **sizes: int
) -> Tensor:
    """The weights of `count` samples, written by `kernel`."""
    out = first.new_empty(count, interface.CORNERS)
    places = (x.contiguous() for x in (first, *given))
    launch(kernel, (triton.cdiv(count, LANES),), *places, out, count, **sizes, LANES=LANES)
    return out


def _move(
    kernel: triton.JITFunction,
    table: Tensor,
    corners: Tensor,
    voxel: Tensor,
    weights: Tensor,
    features: Tensor,
) -> None:
    """Run `kernel`, which moves numbers between `table` and the `features` of samples."""
    count, channels = features.shape
    width = triton.next_power_of_2(max(channels, 1))
    rows = max(BLOCK // width, 1)
    given = table, corners, voxel, weights, features, count, channels
    launch(kernel, (triton.cdiv(count, rows),), *given, ROWS=rows, WIDTH=width)


@triton.jit
def _corner(corners, voxel, weights, i, inside, corner, channels):
    """Offsets of the table rows for one corner of samples, and the corner's weights."""
    v = tl.load(voxel + i, mask=inside, other=0).to(tl.int64)
    row = tl.load(corners + v * CORNERS + corner, mask=inside, other=0).to(tl.int64)
    return row * channels, tl.load(weights + i * CORNERS + corner, mask=inside, other=0.0)


@triton.jit
def _gather(
    table,
    corners,
    voxel,
    weights,
    features,
    count,
    channels,
    ROWS: tl.constexpr,
    WIDTH: tl.constexpr,
):
    i = tl.program_id(0).to(tl.int64) * ROWS + tl.arange(0, ROWS)
    c = tl.arange(0, WIDTH)
    inside = i < count
    there = inside[:, None] & (c < channels)[None, :]
    total = tl.zeros([ROWS, WIDTH], tl.float32)
    for corner in tl.static_range(CORNERS):
        row, weight = _corner(corners, voxel, weights, i, inside, corner, channels)
        value = tl.load(table + row[:, None] + c[None, :], mask=there, other=0.0)
        total += weight[:, None] * value.to(tl.float32)
    tl.store(features + i[:, None] * channels + c[None, :], total, mask=there)


@triton.jit
def _scatter(
    target,
    corners,
    voxel,
    weights,
    grad,
    count,
    channels,
    ROWS: tl.constexpr,
    WIDTH: tl.constexpr,
):
    """Adjoint of `_gather`: target[row] += weight * grad."""
    i = tl.program_id(0).to(tl.int64) * ROWS + tl.arange(0, ROWS)
    c = tl.arange(0, WIDTH)
    inside = i < count
    there = inside[:, None] & (c < channels)[None, :]
    share = tl.load(grad + i[:, None] * channels + c[None, :], mask=there, other=0.0)
    for corner in tl.static_range(CORNERS):
        row, weight = _corner(corners, voxel, weights, i, inside, corner, channels)
        place = target + row[:, None] + c[None, :]
        tl.atomic_add(place, weight[:, None] * share, mask=there, sem="relaxed")


@triton.jit
def _weight(place, corner: tl.constexpr):
    """Trilinear weight of a corner."""
    x, y, z = place
    along_x, along_y = x if corner & 1 else 1 - x, y if corner & 2 else 1 - y
    return along_x * along_y * (z if corner & 4 else 1 - z)


@triton.jit
def _node(a, b, side):
    """A point of the segments from `a` to `b`, `side` lengths from their middle."""
    x = (a[0] + b[0]) * 0.5 + (b[0] - a[0]) * side
    y = (a[1] + b[1]) * 0.5 + (b[1] - a[1]) * side
    z = (a[2] + b[2]) * 0.5 + (b[2] - a[2]) * side
    return x, y, z


@triton.jit
def _put_means(out, i, inside, entry, leave):
    """A weight is a cubic along the segment, for which two Gauss-Legendre nodes are exact."""
    first, second = _node(entry, leave, -GAUSS), _node(entry, leave, GAUSS)
    for corner in tl.static_range(CORNERS):
        mean = 0.5 * (_weight(first, corner) + _weight(second, corner))
        tl.store(out + i * CORNERS + corner, mean, mask=inside)


@triton.jit
def _trilinear(local, out, count, LANES: tl.constexpr):
    i = tl.program_id(0).to(tl.int64) * LANES + tl.arange(0, LANES)
    inside = i < count
    place = vector(local, i, inside)
    for corner in tl.static_range(CORNERS):
        tl.store(out + i * CORNERS + corner, _weight(place, corner), mask=inside)


@triton.jit
def _integral(entry, leave, out, count, LANES: tl.constexpr):
    i = tl.program_id(0).to(tl.int64) * LANES + tl.arange(0, LANES)
    inside = i < count
    _put_means(out, i, inside, vector(entry, i, inside), vector(leave, i, inside))


@triton.jit
def _local(origin, direction, t, size: tl.constexpr, corner):
    """Local coordinate along an axis in the voxel that begins at `corner`, clamped to [0, 1]."""
    place = (origin + t * direction) * size - corner.to(tl.float32)
    return tl.minimum(tl.maximum(place, 0.0), 1.0)


@triton.jit
def _place(o, d, t, size: tl.constexpr, corner):
    return (
        _local(o[0], d[0], t, size, corner[0]),
        _local(o[1], d[1], t, size, corner[1]),
        _local(o[2], d[2], t, size, corner[2]),
    )


@triton.jit
def _integral_along(
    origins,
    directions,
    ray,
    near,
    far,
    coordinates,
    voxel,
    out,
    count,
    SIZE: tl.constexpr,
    LANES: tl.constexpr,
):
    i = tl.program_id(0).to(tl.int64) * LANES + tl.arange(0, LANES)
    inside = i < count
    r = tl.load(ray + i, mask=inside, other=0).to(tl.int64)
    v = tl.load(voxel + i, mask=inside, other=0).to(tl.int64)
    o, d = vector(origins, r, inside), vector(directions, r, inside)
    corner = (
        tl.load(coordinates + 3 * v, mask=inside, other=0),
        tl.load(coordinates + 3 * v + 1, mask=inside, other=0),
        tl.load(coordinates + 3 * v + 2, mask=inside, other=0),
    )
    entry = _place(o, d, tl.load(near + i, mask=inside, other=0.0), SIZE, corner)
    leave = _place(o, d, tl.load(far + i, mask=inside, other=0.0), SIZE, corner)
    _put_means(out, i, inside, entry, leave)

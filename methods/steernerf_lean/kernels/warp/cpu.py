"""Backward warping with numba, one cell at a time."""

from __future__ import annotations

import math

import torch
from numba import njit, prange
from torch import Tensor

from methods.kernels.cpu import f32
from methods.steernerf_lean.kernels.warp import TOLERANCE


def enlarge(depth: Tensor, cells: Tensor, scale: int) -> Tensor:
    """See `methods.steernerf_lean.kernels.warp.enlarge`."""
    if depth.dtype != torch.float32:
        raise ValueError(
            f"backend 'cpu' enlarges float32, got depth {depth.dtype}: use backend='reference'"
        )
    out = torch.empty(len(cells), scale**2)
    _enlarge(depth.contiguous().numpy(), cells.numpy(), scale, f32(TOLERANCE), out.numpy())
    return out


def warp(
    picture: Tensor,
    depth: Tensor,
    cells: Tensor,
    width: int,
    scale: int,
    projection: tuple[Tensor, Tensor],
) -> tuple[Tensor, Tensor]:
    """See `methods.steernerf_lean.kernels.warp.warp`."""
    if not picture.dtype == depth.dtype == torch.float32:
        raise ValueError(
            f"backend 'cpu' warps float32, got picture {picture.dtype}, depth {depth.dtype}: "
            "use backend='reference'"
        )
    values, valid = torch.empty(*depth.shape, picture.shape[2]), torch.empty(depth.shape)
    _warp(
        picture.contiguous().numpy(),
        depth.contiguous().numpy(),
        cells.numpy(),
        width,
        scale,
        *(x.float().numpy() for x in projection),
        values.numpy(),
        valid.numpy(),
    )
    return values, valid


@njit(cache=True, parallel=True)
def _enlarge(depth, cells, scale, tolerance, out):
    width = depth.shape[1]
    for n in prange(len(cells)):
        row, column = cells[n] // width, cells[n] % width
        if not _anything_near(depth, row, column):
            out[n] = math.inf
            continue
        for sub in range(scale * scale):
            v = f32(row * scale + sub // scale) + f32(0.5)
            u = f32(column * scale + sub % scale) + f32(0.5)
            out[n, sub] = _depth_at(
                depth, v / f32(scale) - f32(0.5), u / f32(scale) - f32(0.5), tolerance
            )


@njit(cache=True, parallel=True)
def _warp(picture, depth, cells, width, scale, matrix, offset, values, valid):
    for n in prange(len(cells)):
        row, column = cells[n] // width, cells[n] % width
        for sub in range(scale * scale):
            values[n, sub] = 0
            valid[n, sub] = 0
            z = depth[n, sub]
            if not 0 < z < math.inf:
                continue
            v = f32(row * scale + sub // scale) + f32(0.5)
            u = f32(column * scale + sub % scale) + f32(0.5)
            w = z * (matrix[2, 0] * u + matrix[2, 1] * v + matrix[2, 2]) + offset[2]
            if not w > 0:
                continue
            x = (z * (matrix[0, 0] * u + matrix[0, 1] * v + matrix[0, 2]) + offset[0]) / w
            y = (z * (matrix[1, 0] * u + matrix[1, 1] * v + matrix[1, 2]) + offset[1]) / w
            if 0 <= x < picture.shape[1] and 0 <= y < picture.shape[0]:
                valid[n, sub] = f32(1)
                _look_up(picture, y - f32(0.5), x - f32(0.5), values[n, sub])


@njit(cache=True)
def _anything_near(depth, row, column):
    for y in range(max(row - 1, 0), min(row + 2, depth.shape[0])):
        for x in range(max(column - 1, 0), min(column + 2, depth.shape[1])):
            if -math.inf < depth[y, x] < math.inf:
                return True
    return False


@njit(cache=True)
def _clamp(value, size):
    return min(max(value, 0), size - 1)


@njit(cache=True)
def _depth_at(depth, y, x, tolerance):
    """Depth at a continuous position relative to the centre of pixel (0, 0); inf if none."""
    row, column = math.floor(y), math.floor(x)
    down, right = f32(y - row), f32(x - column)
    top, bottom = _clamp(int(row), depth.shape[0]), _clamp(int(row) + 1, depth.shape[0])
    left, other = _clamp(int(column), depth.shape[1]), _clamp(int(column) + 1, depth.shape[1])
    w0, w1 = (f32(1) - down) * (f32(1) - right), (f32(1) - down) * right
    w2, w3 = down * (f32(1) - right), down * right
    z0, z1 = _known(depth[top, left], w0), _known(depth[top, other], w1)
    z2, z3 = _known(depth[bottom, left], w2), _known(depth[bottom, other], w3)
    limit = min(min(z0, z1), min(z2, z3)) + tolerance
    total, weights = f32(0), f32(0)
    for z, weight in ((z0, w0), (z1, w1), (z2, w2), (z3, w3)):
        if z <= limit and z < math.inf:
            total += weight * z
            weights += weight
    return total / weights if weights > 0 else f32(math.inf)


@njit(cache=True)
def _known(z, weight):
    """The depth `z`; inf if it is not finite or has no weight."""
    return z if weight > 0 and -math.inf < z < math.inf else f32(math.inf)


@njit(cache=True)
def _look_up(picture, y, x, out):
    row, column = math.floor(y), math.floor(x)
    down, right = f32(y - row), f32(x - column)
    top, bottom = _clamp(int(row), picture.shape[0]), _clamp(int(row) + 1, picture.shape[0])
    left, other = _clamp(int(column), picture.shape[1]), _clamp(int(column) + 1, picture.shape[1])
    for c in range(picture.shape[2]):
        above = (f32(1) - right) * picture[top, left, c] + right * picture[top, other, c]
        below = (f32(1) - right) * picture[bottom, left, c] + right * picture[bottom, other, c]
        out[c] = (f32(1) - down) * above + down * below

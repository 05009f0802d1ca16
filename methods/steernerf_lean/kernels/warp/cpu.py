"""Backward warping with numba, one cell at a time."""

from __future__ import annotations

import math

import torch
from numba import njit, prange
from torch import Tensor

from methods.kernels.cpu import arrays, check_float32, f32
from methods.steernerf_lean.kernels.warp import TOLERANCE


def enlarge(depth: Tensor, cells: Tensor, scale: int) -> Tensor:
    """As the reference, of float32."""
    check_float32(depth)
    out = torch.empty(len(cells), scale**2)
    _enlarge(*arrays(depth, cells), scale, f32(TOLERANCE), out.numpy())
    return out


def warp(
    picture: Tensor,
    depth: Tensor,
    cells: Tensor,
    width: int,
    scale: int,
    projection: tuple[Tensor, Tensor],
) -> tuple[Tensor, Tensor]:
    """As the reference, of float32."""
    check_float32(picture, depth)
    values, valid = torch.empty(*depth.shape, picture.shape[2]), torch.empty(depth.shape)
    camera = (x.float() for x in projection)
    _warp(*arrays(picture, depth, cells), width, scale, *arrays(*camera, values, valid))
    return values, valid


@njit(cache=True, parallel=True)
def _enlarge(depth, cells, scale, tolerance, out):
    width = depth.shape[1]
    for n in prange(len(cells)):
        row, column = cells[n] // width, cells[n] % width
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
def _corners(y, x, height, width):
    """Rows, columns, and fractions on the way to the second ones, around (y, x) relative to the
    centre of pixel (0, 0)."""
    row, column = math.floor(y), math.floor(x)
    top, bottom = min(max(int(row), 0), height - 1), min(max(int(row) + 1, 0), height - 1)
    left, right = min(max(int(column), 0), width - 1), min(max(int(column) + 1, 0), width - 1)
    return top, bottom, left, right, f32(y - row), f32(x - column)


@njit(cache=True)
def _depth_at(depth, y, x, tolerance):
    """The mean depth at (y, x); inf if there is none."""
    top, bottom, left, right, down, across = _corners(y, x, *depth.shape)
    w0, w1 = (f32(1) - down) * (f32(1) - across), (f32(1) - down) * across
    w2, w3 = down * (f32(1) - across), down * across
    z0, z1 = _known(depth[top, left], w0), _known(depth[top, right], w1)
    z2, z3 = _known(depth[bottom, left], w2), _known(depth[bottom, right], w3)
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
    top, bottom, left, right, down, across = _corners(y, x, picture.shape[0], picture.shape[1])
    for c in range(picture.shape[2]):
        above = (f32(1) - across) * picture[top, left, c] + across * picture[top, right, c]
        below = (f32(1) - across) * picture[bottom, left, c] + across * picture[bottom, right, c]
        out[c] = (f32(1) - down) * above + down * below

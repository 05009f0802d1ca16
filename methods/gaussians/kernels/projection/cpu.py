"""Projection of Gaussians with numba: one pass, in vectors of Gaussians."""

import math

import numpy as np
import torch
from numba import prange
from torch import Tensor

from bench.types import Camera
from methods.gaussians.kernels.projection import BLUR, FRUSTUM, LEAST_ALPHA, NEAR, Ellipses
from methods.kernels.cpu import arrays, check_float32, f32, jit, three

ZERO, ONE, TWO = f32(0), f32(1), f32(2)
BLUR32, NEAR32, INFINITE = f32(BLUR), f32(NEAR), f32(np.inf)
BLOCK = 256  # Gaussians at a time; their numbers, inputs and results, stay in the first-level cache


def project_gaussians(
    means: Tensor, scales: Tensor, rotations: Tensor, opacities: Tensor, camera: Camera
) -> Ellipses:
    check_float32(means, scales, rotations)
    return Ellipses(*_Project.apply(means, scales, rotations, opacities, camera))


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means, scales, rotations, opacities, camera):
        inputs = [x.detach().contiguous() for x in (means, scales, rotations)]
        ctx.view = _view(camera)
        found = [torch.empty(len(means), size) for size in (2, 3, 1, 2)]
        reach = 2 * (opacities.detach() / LEAST_ALPHA).log()  # NaN or below 0: too faint
        given = tuple(arrays(*inputs, reach[:, None]))
        _forward(given, *ctx.view, tuple(arrays(*found)))
        centres, conics, depth, extents = found
        depth = depth.squeeze(1)
        ctx.save_for_backward(*inputs, conics, extents)
        ctx.mark_non_differentiable(depth, extents)
        return centres, conics, depth, extents

    @staticmethod
    def backward(ctx, grad_centres, grad_conics, _depth, _extents):
        given = tuple(arrays(*ctx.saved_tensors, grad_centres, grad_conics))
        grads = [torch.empty(x.shape) for x in ctx.saved_tensors[:3]]
        _backward(given, *ctx.view, tuple(arrays(*grads)))
        return (*grads, None, None)


def _view(camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """W [3, 3] and centre [3] of a camera; fx, fy, cx, cy and limits of x / z and y / z in J."""
    pose = camera.c2w.numpy().astype(np.float32)
    limits = FRUSTUM * 0.5 * camera.width / camera.fx, FRUSTUM * 0.5 * camera.height / camera.fy
    intrinsics = np.array((camera.fx, camera.fy, camera.cx, camera.cy, *limits), np.float32)
    return np.ascontiguousarray(pose[:, :3].T), np.ascontiguousarray(pose[:, 3]), intrinsics


@jit()
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@jit()
def _load(block, sources, first, size):
    """Copy `size` rows of each source, from `first` on; their columns become rows of the block."""
    row = 0
    for source in sources:
        for column in range(source.shape[1]):
            for i in range(size):
                block[row * BLOCK + i] = source[first + i, column]
            row += 1


@jit()
def _store(block, row, targets, first, size):
    """The way back of `_load`, from a `row` of the block on."""
    for target in targets:
        for column in range(target.shape[1]):
            for i in range(size):
                target[first + i, column] = block[row * BLOCK + i]
            row += 1


@jit()
def _three(block, row, i):
    """Three rows of the block, from `row` on, of Gaussian `i`."""
    return block[row * BLOCK + i], block[(row + 1) * BLOCK + i], block[(row + 2) * BLOCK + i]


@jit(error_model="numpy")
def _place(block, i, w0, w1, w2, origin, limit_x, limit_y):
    """Depth z of Gaussian `i`, 1 / z, x / z and y / z, and the last two within the limits of J."""
    x, y, z = _three(block, 0, i)
    mean = x - origin[0], y - origin[1], z - origin[2]
    depth = _dot(w2, mean)
    inverse = ONE / depth
    u, v = _dot(w0, mean) * inverse, _dot(w1, mean) * inverse
    tx = min(max(u, -limit_x), limit_x)
    ty = min(max(v, -limit_y), limit_y)
    return depth, inverse, u, v, tx, ty


@jit(error_model="numpy")
def _rotation(qw, qx, qy, qz):
    """Columns of R of a quaternion, and 1 over its length."""
    inverse = ONE / math.sqrt(qw * qw + qx * qx + qy * qy + qz * qz)
    w, x, y, z = qw * inverse, qx * inverse, qy * inverse, qz * inverse
    return (
        (ONE - TWO * (y * y + z * z), TWO * (x * y + w * z), TWO * (x * z - w * y)),
        (TWO * (x * y - w * z), ONE - TWO * (x * x + z * z), TWO * (y * z + w * x)),
        (TWO * (x * z + w * y), TWO * (y * z - w * x), ONE - TWO * (x * x + y * y)),
        inverse,
    )


@jit(parallel=True, error_model="numpy")
def _forward(given, world, origin, view, out):
    count = len(given[0])
    for chunk in prange((count + BLOCK - 1) // BLOCK):
        first, size = chunk * BLOCK, min(BLOCK, count - chunk * BLOCK)
        block = np.empty(19 * BLOCK, np.float32)
        _load(block, given, first, size)
        _project(block, size, world, origin, view)
        _store(block, 11, out, first, size)


@jit(error_model="numpy")
def _project(block, size, world, origin, view):
    """Rows of the block: means, scales, quaternions and reach; centres, conics, depth, extents."""
    fx, fy, cx, cy, limit_x, limit_y = view
    w0, w1, w2 = three(world, 0), three(world, 1), three(world, 2)
    centre = origin[0], origin[1], origin[2]
    for i in range(size):  # one array and no branch: LLVM makes vectors of it
        z, inverse, u, v, tx, ty = _place(block, i, w0, w1, w2, centre, limit_x, limit_y)
        s0, s1, s2 = _three(block, 3, i)
        qx, qy, qz = _three(block, 7, i)
        r0, r1, r2, _ = _rotation(block[6 * BLOCK + i], qx, qy, qz)
        rise = block[10 * BLOCK + i]
        # Rows of J W R diag s.
        ax, ay = fx * inverse, fy * inverse
        v20, v21, v22 = _dot(w2, r0), _dot(w2, r1), _dot(w2, r2)
        h0, k0 = ax * (_dot(w0, r0) - tx * v20) * s0, ay * (_dot(w1, r0) - ty * v20) * s0
        h1, k1 = ax * (_dot(w0, r1) - tx * v21) * s1, ay * (_dot(w1, r1) - ty * v21) * s1
        h2, k2 = ax * (_dot(w0, r2) - tx * v22) * s2, ay * (_dot(w1, r2) - ty * v22) * s2
        xx = h0 * h0 + h1 * h1 + h2 * h2 + BLUR32
        xy = h0 * k0 + h1 * k1 + h2 * k2
        yy = k0 * k0 + k1 * k1 + k2 * k2 + BLUR32
        per_area = ONE / (xx * yy - xy * xy)
        a, b, c = yy * per_area, -xy * per_area, xx * per_area
        finite = abs(a + b + c) + abs(u + v) < INFINITE
        shown = (z > NEAR32) & (rise >= ZERO) & finite
        block[11 * BLOCK + i] = fx * u + cx if shown else ZERO
        block[12 * BLOCK + i] = fy * v + cy if shown else ZERO
        block[13 * BLOCK + i] = a if shown else ZERO
        block[14 * BLOCK + i] = b if shown else ZERO
        block[15 * BLOCK + i] = c if shown else ZERO
        block[16 * BLOCK + i] = z
        block[17 * BLOCK + i] = math.sqrt(rise * xx) if shown else ZERO
        block[18 * BLOCK + i] = math.sqrt(rise * yy) if shown else ZERO


@jit(parallel=True, error_model="numpy")
def _backward(given, world, origin, view, out):
    count = len(given[0])
    for chunk in prange((count + BLOCK - 1) // BLOCK):
        first, size = chunk * BLOCK, min(BLOCK, count - chunk * BLOCK)
        block = np.empty(30 * BLOCK, np.float32)
        _load(block, given, first, size)
        _differentiate(block, size, world, origin, view)
        _store(block, 20, out, first, size)


@jit(error_model="numpy")
def _differentiate(block, size, world, origin, view):
    """With H = J W R diag s, V' = H H^T + BLUR I and Q = V'^-1: dL/dV' = -Q dL/dQ Q, and
    dL/dH = 2 dL/dV' H.

    Rows of the block: means, scales, quaternions, conics, extents and gradients of centres and
    conics; gradients of means, scales and quaternions.
    """
    fx, fy, _, _, limit_x, limit_y = view
    w0, w1, w2 = three(world, 0), three(world, 1), three(world, 2)
    c0, c1, c2 = three(world.T, 0), three(world.T, 1), three(world.T, 2)
    centre = origin[0], origin[1], origin[2]
    for i in range(size):  # one array and no branch: LLVM makes vectors of it
        _, inverse, u, v, tx, ty = _place(block, i, w0, w1, w2, centre, limit_x, limit_y)
        s0, s1, s2 = _three(block, 3, i)
        qw = block[6 * BLOCK + i]
        qx, qy, qz = _three(block, 7, i)
        a, b, c = _three(block, 10, i)
        shown = block[13 * BLOCK + i] > ZERO
        r0, r1, r2, shrink = _rotation(qw, qx, qy, qz)
        ax, ay = fx * inverse, fy * inverse

        # dL/dV' is symmetric: each off-diagonal entry is half of dL/dB.
        ga, twice_gb, gc = _three(block, 17, i)
        gb = twice_gb / TWO
        p00, p01 = a * ga + b * gb, a * gb + b * gc
        p10, p11 = b * ga + c * gb, b * gb + c * gc
        g = -(p00 * a + p01 * b), -(p00 * b + p01 * c), -(p10 * b + p11 * c)

        # Gradients of H by column, hence of scales, of W R, of x / z, y / z and of ax, ay.
        e0, m0, gt0 = _column(g, ax, ay, tx, ty, s0, _dot(w0, r0), _dot(w1, r0), _dot(w2, r0))
        e1, m1, gt1 = _column(g, ax, ay, tx, ty, s1, _dot(w0, r1), _dot(w1, r1), _dot(w2, r1))
        e2, m2, gt2 = _column(g, ax, ay, tx, ty, s2, _dot(w0, r2), _dot(w1, r2), _dot(w2, r2))
        gu, gv = fx * block[15 * BLOCK + i], fy * block[16 * BLOCK + i]
        gu += gt0[0] + gt1[0] + gt2[0] if tx == u else ZERO
        gv += gt0[1] + gt1[1] + gt2[1] if ty == v else ZERO
        gax, gay = gt0[2] + gt1[2] + gt2[2], gt0[3] + gt1[3] + gt2[3]
        gz = -(gu * u + gv * v + gax * ax + gay * ay) * inverse
        along = gu * inverse, gv * inverse, gz
        block[20 * BLOCK + i] = _dot(c0, along) if shown else ZERO  # W^T
        block[21 * BLOCK + i] = _dot(c1, along) if shown else ZERO
        block[22 * BLOCK + i] = _dot(c2, along) if shown else ZERO
        block[23 * BLOCK + i] = e0 if shown else ZERO
        block[24 * BLOCK + i] = e1 if shown else ZERO
        block[25 * BLOCK + i] = e2 if shown else ZERO

        # dL/dR = W^T dL/d(W R), by its entries.
        n00, n10, n20 = _dot(c0, m0), _dot(c1, m0), _dot(c2, m0)
        n01, n11, n21 = _dot(c0, m1), _dot(c1, m1), _dot(c2, m1)
        n02, n12, n22 = _dot(c0, m2), _dot(c1, m2), _dot(c2, m2)
        w, x, y, z = qw * shrink, qx * shrink, qy * shrink, qz * shrink
        gw = TWO * (x * (n21 - n12) + y * (n02 - n20) + z * (n10 - n01))
        gx = TWO * (w * (n21 - n12) - TWO * x * (n11 + n22) + y * (n01 + n10) + z * (n02 + n20))
        gy = TWO * (w * (n02 - n20) + x * (n01 + n10) - TWO * y * (n00 + n22) + z * (n12 + n21))
        gz = TWO * (w * (n10 - n01) + x * (n02 + n20) + y * (n12 + n21) - TWO * z * (n00 + n11))
        # Normalised: no gradient along the quaternion.
        same = gw * w + gx * x + gy * y + gz * z
        block[26 * BLOCK + i] = (gw - same * w) * shrink if shown else ZERO
        block[27 * BLOCK + i] = (gx - same * x) * shrink if shown else ZERO
        block[28 * BLOCK + i] = (gy - same * y) * shrink if shown else ZERO
        block[29 * BLOCK + i] = (gz - same * z) * shrink if shown else ZERO


@jit()
def _column(g, ax, ay, tx, ty, s, across, down, depth):
    """What one column of W R, (across, down, depth), has of the gradients: its scale, itself, and
    tx, ty, ax, ay."""
    h, j = ax * (across - tx * depth) * s, ay * (down - ty * depth) * s
    gh, gj = TWO * (g[0] * h + g[1] * j), TWO * (g[1] * h + g[2] * j)
    wide, tall = gh * (across - tx * depth), gj * (down - ty * depth)
    d0, d1 = gh * ax * s, gj * ay * s
    return (
        wide * ax + tall * ay,
        (d0, d1, -d0 * tx - d1 * ty),
        (-d0 * depth, -d1 * depth, wide * s, tall * s),
    )

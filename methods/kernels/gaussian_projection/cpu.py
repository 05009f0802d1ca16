"""Projection of Gaussians with numba: one pass, in registers."""

from __future__ import annotations

import math

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from bench.types import Camera
from methods.kernels.cpu import f32
from methods.kernels.gaussian_projection import BLUR, FRUSTUM, LEAST_ALPHA, NEAR, Ellipses

ZERO, ONE, TWO = f32(0), f32(1), f32(2)
BLUR32, NEAR32, LEAST32 = f32(BLUR), f32(NEAR), f32(LEAST_ALPHA)


def project_gaussians(
    means: Tensor, scales: Tensor, rotations: Tensor, opacities: Tensor, camera: Camera
) -> Ellipses:
    """See `methods.kernels.gaussian_projection.project_gaussians`."""
    if means.dtype != torch.float32:
        raise ValueError(f"backend 'cpu' projects float32, got {means.dtype}")
    return Ellipses(*_Project.apply(means, scales, rotations, opacities, camera))


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means, scales, rotations, opacities, camera):
        inputs = [x.detach().contiguous() for x in (means, scales, rotations)]
        view = _view(camera)
        count = len(means)
        found = [torch.zeros(count, size) for size in (2, 3, 1, 2)]
        _forward(
            *(x.numpy() for x in inputs),
            opacities.contiguous().numpy(),
            *view,
            *(x.numpy() for x in found),
        )
        centres, conics, depth, extents = found
        depth = depth.squeeze(1)
        ctx.save_for_backward(*inputs, conics, extents)
        ctx.view = view
        ctx.mark_non_differentiable(depth, extents)
        return centres, conics, depth, extents

    @staticmethod
    def backward(ctx, grad_centres, grad_conics, _depth, _extents):
        *inputs, conics, extents = ctx.saved_tensors
        grads = [torch.zeros_like(x) for x in inputs]
        _backward(
            *(x.numpy() for x in (*inputs, conics, extents)),
            *ctx.view,
            grad_centres.contiguous().numpy(),
            grad_conics.contiguous().numpy(),
            *(x.numpy() for x in grads),
        )
        return (*grads, None, None)


def _view(camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """W [3, 3] and centre [3] of a camera; fx, fy, cx, cy and limits of x / z and y / z in J."""
    pose = camera.c2w.numpy().astype(np.float32)
    limits = FRUSTUM * 0.5 * camera.width / camera.fx, FRUSTUM * 0.5 * camera.height / camera.fy
    intrinsics = np.array((camera.fx, camera.fy, camera.cx, camera.cy, *limits), np.float32)
    return np.ascontiguousarray(pose[:, :3].T), np.ascontiguousarray(pose[:, 3]), intrinsics


@njit(cache=True)
def _rotation(q):
    """Rows of R of a quaternion, and 1 over its length."""
    inverse = ONE / math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    w, x, y, z = q[0] * inverse, q[1] * inverse, q[2] * inverse, q[3] * inverse
    return (
        (ONE - TWO * (y * y + z * z), TWO * (x * y - w * z), TWO * (x * z + w * y)),
        (TWO * (x * y + w * z), ONE - TWO * (x * x + z * z), TWO * (y * z - w * x)),
        (TWO * (x * z - w * y), TWO * (y * z + w * x), ONE - TWO * (x * x + y * y)),
        inverse,
    )


@njit(cache=True)
def _times(world, r0, r1, r2, row):
    """Row `row` of W R."""
    a, b, c = world[row, 0], world[row, 1], world[row, 2]
    return (
        a * r0[0] + b * r1[0] + c * r2[0],
        a * r0[1] + b * r1[1] + c * r2[1],
        a * r0[2] + b * r1[2] + c * r2[2],
    )


@njit(cache=True)
def _local(mean, world, origin):
    x, y, z = mean[0] - origin[0], mean[1] - origin[1], mean[2] - origin[2]
    return (
        world[0, 0] * x + world[0, 1] * y + world[0, 2] * z,
        world[1, 0] * x + world[1, 1] * y + world[1, 2] * z,
        world[2, 0] * x + world[2, 1] * y + world[2, 2] * z,
    )


@njit(cache=True, parallel=True)
def _forward(
    means, scales, rotations, opacities, world, origin, view, centres, conics, depth, extents
):
    fx, fy, cx, cy, limit_x, limit_y = view
    for i in prange(len(means)):
        x, y, z = _local(means[i], world, origin)
        depth[i, 0] = z
        if not (z > NEAR32 and opacities[i] >= LEAST32):
            continue
        r0, r1, r2, _ = _rotation(rotations[i])
        v0 = _times(world, r0, r1, r2, 0)
        v1 = _times(world, r0, r1, r2, 1)
        v2 = _times(world, r0, r1, r2, 2)
        s0, s1, s2 = scales[i, 0], scales[i, 1], scales[i, 2]
        inverse = ONE / z
        u, v = x * inverse, y * inverse
        tx = min(max(u, -limit_x), limit_x)
        ty = min(max(v, -limit_y), limit_y)
        # Rows of J W R diag s.
        ax, ay = fx * inverse, fy * inverse
        h0, k0 = ax * (v0[0] - tx * v2[0]) * s0, ay * (v1[0] - ty * v2[0]) * s0
        h1, k1 = ax * (v0[1] - tx * v2[1]) * s1, ay * (v1[1] - ty * v2[1]) * s1
        h2, k2 = ax * (v0[2] - tx * v2[2]) * s2, ay * (v1[2] - ty * v2[2]) * s2
        xx = h0 * h0 + h1 * h1 + h2 * h2 + BLUR32
        xy = h0 * k0 + h1 * k1 + h2 * k2
        yy = k0 * k0 + k1 * k1 + k2 * k2 + BLUR32
        area = xx * yy - xy * xy
        a, b, c = yy / area, -xy / area, xx / area
        if not (math.isfinite(a + b + c) and math.isfinite(u + v)):
            continue
        centres[i, 0], centres[i, 1] = fx * u + cx, fy * v + cy
        conics[i, 0], conics[i, 1], conics[i, 2] = a, b, c
        reach = TWO * math.log(opacities[i] / LEAST32)
        extents[i, 0], extents[i, 1] = math.sqrt(reach * xx), math.sqrt(reach * yy)


@njit(cache=True, parallel=True)
def _backward(
    means,
    scales,
    rotations,
    conics,
    extents,
    world,
    origin,
    view,
    grad_centres,
    grad_conics,
    grad_means,
    grad_scales,
    grad_rotations,
):
    """With H = J W R diag s, V' = H H^T + BLUR I and Q = V'^-1: dL/dV' = -Q dL/dQ Q, and
    dL/dH = 2 dL/dV' H."""
    fx, fy, _, _, limit_x, limit_y = view
    for i in prange(len(means)):
        if extents[i, 0] == ZERO:
            continue
        x, y, z = _local(means[i], world, origin)
        r0, r1, r2, shrink = _rotation(rotations[i])
        v0 = _times(world, r0, r1, r2, 0)
        v1 = _times(world, r0, r1, r2, 1)
        v2 = _times(world, r0, r1, r2, 2)
        s = scales[i, 0], scales[i, 1], scales[i, 2]
        inverse = ONE / z
        u, v = x * inverse, y * inverse
        tx = min(max(u, -limit_x), limit_x)
        ty = min(max(v, -limit_y), limit_y)
        ax, ay = fx * inverse, fy * inverse

        # dL/dV' is symmetric: each off-diagonal entry is half of dL/dB.
        a, b, c = conics[i, 0], conics[i, 1], conics[i, 2]
        ga, gb, gc = grad_conics[i, 0], grad_conics[i, 1] / TWO, grad_conics[i, 2]
        p00, p01 = a * ga + b * gb, a * gb + b * gc
        p10, p11 = b * ga + c * gb, b * gb + c * gc
        gxx = -(p00 * a + p01 * b)
        gxy = -(p00 * b + p01 * c)
        gyy = -(p10 * b + p11 * c)

        # Gradients of H, then of the scales, of W R (rows m0, m1, m2), of x / z, y / z and 1 / z.
        gtx, gty, gax, gay = ZERO, ZERO, ZERO, ZERO
        m0, m1, m2 = (ZERO, ZERO, ZERO), (ZERO, ZERO, ZERO), (ZERO, ZERO, ZERO)
        for k in range(3):
            across, down = v0[k] - tx * v2[k], v1[k] - ty * v2[k]
            h, j = ax * across * s[k], ay * down * s[k]
            gh = TWO * (gxx * h + gxy * j)
            gj = TWO * (gxy * h + gyy * j)
            grad_scales[i, k] = gh * ax * across + gj * ay * down
            gax += gh * across * s[k]
            gay += gj * down * s[k]
            gtx -= gh * ax * s[k] * v2[k]
            gty -= gj * ay * s[k] * v2[k]
            d0, d1 = gh * ax * s[k], gj * ay * s[k]
            m0 = _with(m0, k, d0)
            m1 = _with(m1, k, d1)
            m2 = _with(m2, k, -d0 * tx - d1 * ty)

        gu, gv = fx * grad_centres[i, 0], fy * grad_centres[i, 1]
        if tx == u:
            gu += gtx
        if ty == v:
            gv += gty
        gx, gy = gu * inverse, gv * inverse
        gz = -(gu * u + gv * v + gax * ax + gay * ay) * inverse
        for k in range(3):  # W^T
            grad_means[i, k] = world[0, k] * gx + world[1, k] * gy + world[2, k] * gz

        # dL/dR = W^T dL/d(W R).
        n0 = _back(world, m0, m1, m2, 0)
        n1 = _back(world, m0, m1, m2, 1)
        n2 = _back(world, m0, m1, m2, 2)
        q = rotations[i]
        w, x, y, z = q[0] * shrink, q[1] * shrink, q[2] * shrink, q[3] * shrink
        gw = TWO * (x * (n2[1] - n1[2]) + y * (n0[2] - n2[0]) + z * (n1[0] - n0[1]))
        gx = TWO * (
            w * (n2[1] - n1[2])
            - TWO * x * (n1[1] + n2[2])
            + y * (n0[1] + n1[0])
            + z * (n0[2] + n2[0])
        )
        gy = TWO * (
            w * (n0[2] - n2[0])
            + x * (n0[1] + n1[0])
            - TWO * y * (n0[0] + n2[2])
            + z * (n1[2] + n2[1])
        )
        gz = TWO * (
            w * (n1[0] - n0[1])
            + x * (n0[2] + n2[0])
            + y * (n1[2] + n2[1])
            - TWO * z * (n0[0] + n1[1])
        )
        along = gw * w + gx * x + gy * y + gz * z  # normalised: no gradient along the quaternion
        grad_rotations[i, 0] = (gw - along * w) * shrink
        grad_rotations[i, 1] = (gx - along * x) * shrink
        grad_rotations[i, 2] = (gy - along * y) * shrink
        grad_rotations[i, 3] = (gz - along * z) * shrink


@njit(cache=True)
def _with(row, k, value):
    if k == 0:
        return value, row[1], row[2]
    if k == 1:
        return row[0], value, row[2]
    return row[0], row[1], value


@njit(cache=True)
def _back(world, m0, m1, m2, row):
    """Row `row` of W^T M."""
    a, b, c = world[0, row], world[1, row], world[2, row]
    return (
        a * m0[0] + b * m1[0] + c * m2[0],
        a * m0[1] + b * m1[1] + c * m2[1],
        a * m0[2] + b * m1[2] + c * m2[2],
    )

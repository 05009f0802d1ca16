"""Projection of Gaussians with Triton: one lane per Gaussian, in registers.

It reads the 44 bytes of a Gaussian and writes the 32 bytes of its ellipse. The backward pass
recomputes intermediate results, which is cheaper than reading them.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from bench.types import Camera
from methods.gaussians.kernels.projection import FRUSTUM, Ellipses
from methods.kernels import gaussian_projection as interface
from methods.kernels.gpu import check_types, launch, vector

BLOCK = 128  # Gaussians

BLUR, NEAR = tl.constexpr(interface.BLUR), tl.constexpr(interface.NEAR)
LEAST = tl.constexpr(interface.LEAST_ALPHA)


def project_gaussians(
    means: Tensor, scales: Tensor, rotations: Tensor, opacities: Tensor, camera: Camera
) -> Ellipses:
    """See `methods.gaussians.kernels.projection.project_gaussians`."""
    given = {"means": means, "scales": scales, "rotations": rotations, "opacities": opacities}
    check_types(torch.float32, **given)
    return Ellipses(*_Project.apply(*given.values(), camera))


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means, scales, rotations, opacities, camera):
        count = len(means)
        inputs = [x.detach().contiguous() for x in (means, scales, rotations)]
        pose = camera.c2w.contiguous()
        centres, conics, extents = (means.new_empty(count, size) for size in (2, 3, 2))
        depth = means.new_empty(count)
        launch(
            _forward,
            (triton.cdiv(count, BLOCK),),
            *inputs,
            opacities.contiguous(),
            pose,
            *_view(camera),
            centres,
            conics,
            depth,
            extents,
            count,
            BLOCK=BLOCK,
        )
        ctx.save_for_backward(*inputs, pose, conics, extents)
        ctx.view = _view(camera)
        ctx.mark_non_differentiable(depth, extents)
        return centres, conics, depth, extents

    @staticmethod
    def backward(ctx, grad_centres, grad_conics, _depth, _extents):
        *inputs, pose, conics, extents = ctx.saved_tensors
        grads = [torch.empty_like(x) for x in inputs]
        count = len(conics)
        launch(
            _backward,
            (triton.cdiv(count, BLOCK),),
            *inputs,
            pose,
            *ctx.view,
            conics,
            extents,
            grad_centres.contiguous(),
            grad_conics.contiguous(),
            *grads,
            count,
            BLOCK=BLOCK,
        )
        return (*grads, None, None)


def _view(camera: Camera) -> tuple[float, ...]:
    """fx, fy, cx, cy, and the limits of x / z and y / z in J."""
    limits = FRUSTUM * 0.5 * camera.width / camera.fx, FRUSTUM * 0.5 * camera.height / camera.fy
    return camera.fx, camera.fy, camera.cx, camera.cy, *limits


@triton.jit
def _put(vectors, i, x, y, z, inside):
    tl.store(vectors + 3 * i, x, mask=inside)
    tl.store(vectors + 3 * i + 1, y, mask=inside)
    tl.store(vectors + 3 * i + 2, z, mask=inside)


@triton.jit
def _axis(pose, k: tl.constexpr):
    """The k-th axis of the camera in the world: a row of W."""
    return tl.load(pose + k), tl.load(pose + 4 + k), tl.load(pose + 8 + k)


@triton.jit
def _finite(x, y, z):
    return tl.abs(x) + tl.abs(y) + tl.abs(z) < float("inf")


@triton.jit
def _local(means, pose, i, inside):
    """Centres in camera coordinates; z is NaN for centres that are not finite."""
    x, y, z = vector(means, i, inside)
    finite = _finite(x, y, z)
    x = tl.where(finite, x, 0.0) - tl.load(pose + 3)
    y = tl.where(finite, y, 0.0) - tl.load(pose + 7)
    z = tl.where(finite, z, 0.0) - tl.load(pose + 11)
    deep = tl.where(finite, _along(pose, 2, x, y, z), float("nan"))
    return _along(pose, 0, x, y, z), _along(pose, 1, x, y, z), deep


@triton.jit
def _along(pose, k: tl.constexpr, x, y, z):
    a, b, c = _axis(pose, k)
    return a * x + b * y + c * z


@triton.jit
def _rotation(rotations, i, inside):
    """Normalised quaternions (w, x, y, z), and 1 over their lengths."""
    w = tl.load(rotations + 4 * i, mask=inside, other=1.0)
    x = tl.load(rotations + 4 * i + 1, mask=inside, other=0.0)
    y = tl.load(rotations + 4 * i + 2, mask=inside, other=0.0)
    z = tl.load(rotations + 4 * i + 3, mask=inside, other=0.0)
    # Correctly rounded, because an error of the length enters a conic four times.
    shrink = tl.div_rn(1.0, tl.sqrt_rn(w * w + x * x + y * y + z * z))
    return w * shrink, x * shrink, y * shrink, z * shrink, shrink


@triton.jit
def _column(w, x, y, z, k: tl.constexpr):
    """The k-th column of R: an axis of the Gaussian."""
    if k == 0:
        return 1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)
    elif k == 1:
        return 2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)
    else:
        return 2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)


@triton.jit
def _slopes(pose, w, x, y, z, tx, ty, k: tl.constexpr):
    """The k-th column of J W R without the factors f / z, for both axes of the picture.

    Also the component of that axis of the Gaussian along the camera's axis.
    """
    a, b, c = _column(w, x, y, z, k)
    deep = _along(pose, 2, a, b, c)
    return _along(pose, 0, a, b, c) - tx * deep, _along(pose, 1, a, b, c) - ty * deep, deep


@triton.jit
def _forward(
    means,
    scales,
    rotations,
    opacities,
    pose,
    fx,
    fy,
    cx,
    cy,
    limit_x,
    limit_y,
    centres,
    conics,
    depth,
    extents,
    count,
    BLOCK: tl.constexpr,
):
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = i < count
    x, y, z = _local(means, pose, i, inside)
    tl.store(depth + i, z, mask=inside)
    opacity = tl.load(opacities + i, mask=inside, other=0.0)
    s0, s1, s2 = vector(scales, i, inside)
    shown = inside & (z > NEAR) & (opacity >= LEAST) & _finite(s0, s1, s2)
    s0, s1, s2 = tl.where(shown, s0, 0.0), tl.where(shown, s1, 0.0), tl.where(shown, s2, 0.0)
    inverse = 1 / tl.where(shown, z, 1.0)
    u, v = x * inverse, y * inverse
    tx = tl.minimum(tl.maximum(u, -limit_x), limit_x)
    ty = tl.minimum(tl.maximum(v, -limit_y), limit_y)
    ax, ay = fx * inverse, fy * inverse
    qw, qx, qy, qz, _ = _rotation(rotations, i, shown)
    across0, down0, _ = _slopes(pose, qw, qx, qy, qz, tx, ty, 0)
    across1, down1, _ = _slopes(pose, qw, qx, qy, qz, tx, ty, 1)
    across2, down2, _ = _slopes(pose, qw, qx, qy, qz, tx, ty, 2)
    # Columns of J W R diag s.
    h0, k0 = ax * across0 * s0, ay * down0 * s0
    h1, k1 = ax * across1 * s1, ay * down1 * s1
    h2, k2 = ax * across2 * s2, ay * down2 * s2
    xx = h0 * h0 + h1 * h1 + h2 * h2 + BLUR
    xy = h0 * k0 + h1 * k1 + h2 * k2
    yy = k0 * k0 + k1 * k1 + k2 * k2 + BLUR
    area = xx * yy - xy * xy
    a, b, c = yy / area, -xy / area, xx / area
    shown = shown & (tl.abs(a + b + c) < float("inf")) & (tl.abs(u + v) < float("inf"))
    tl.store(centres + 2 * i, tl.where(shown, fx * u + cx, 0.0), mask=inside)
    tl.store(centres + 2 * i + 1, tl.where(shown, fy * v + cy, 0.0), mask=inside)
    a, b, c = tl.where(shown, a, 0.0), tl.where(shown, b, 0.0), tl.where(shown, c, 0.0)
    _put(conics, i, a, b, c, inside)
    # On a GPU, the quotient of equal numbers may be slightly below 1.
    reach = 2 * tl.log(tl.where(shown, tl.maximum(opacity / LEAST, 1.0), 1.0))
    wide, tall = tl.sqrt(reach * xx), tl.sqrt(reach * yy)
    tl.store(extents + 2 * i, tl.where(shown, wide, 0.0), mask=inside)
    tl.store(extents + 2 * i + 1, tl.where(shown, tall, 0.0), mask=inside)


@triton.jit
def _backward(
    means,
    scales,
    rotations,
    pose,
    fx,
    fy,
    cx,
    cy,
    limit_x,
    limit_y,
    conics,
    extents,
    grad_centres,
    grad_conics,
    grad_means,
    grad_scales,
    grad_rotations,
    count,
    BLOCK: tl.constexpr,
):
    """With H = J W R diag s, V' = H H^T + BLUR I and Q = V'^-1: dL/dV' = -Q dL/dQ Q, and
    dL/dH = 2 dL/dV' H."""
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = i < count
    shown = inside & (tl.load(extents + 2 * i, mask=inside, other=0.0) > 0)
    x, y, z = _local(means, pose, i, shown)
    inverse = 1 / tl.where(shown, z, 1.0)
    u, v = x * inverse, y * inverse
    tx = tl.minimum(tl.maximum(u, -limit_x), limit_x)
    ty = tl.minimum(tl.maximum(v, -limit_y), limit_y)
    ax, ay = fx * inverse, fy * inverse
    qw, qx, qy, qz, shrink = _rotation(rotations, i, shown)
    s0, s1, s2 = vector(scales, i, shown)

    # dL/dV' is symmetric: each off-diagonal entry is half of dL/dB.
    a, b, c = vector(conics, i, shown)
    ga, gb, gc = vector(grad_conics, i, shown)
    gb = gb / 2
    p00, p01 = a * ga + b * gb, a * gb + b * gc
    p10, p11 = b * ga + c * gb, b * gb + c * gc
    gxx, gxy, gyy = -(p00 * a + p01 * b), -(p00 * b + p01 * c), -(p10 * b + p11 * c)

    # Gradients of H, then of the scales, of W R diag s (by columns) and of J.
    across, down, deep = _slopes(pose, qw, qx, qy, qz, tx, ty, 0)
    gs0, gh0, gk0, gax, gay, gtx, gty = _of_axis(across, down, deep, s0, ax, ay, gxx, gxy, gyy)
    across, down, deep = _slopes(pose, qw, qx, qy, qz, tx, ty, 1)
    gs1, gh1, gk1, hax, hay, htx, hty = _of_axis(across, down, deep, s1, ax, ay, gxx, gxy, gyy)
    across, down, deep = _slopes(pose, qw, qx, qy, qz, tx, ty, 2)
    gs2, gh2, gk2, kax, kay, ktx, kty = _of_axis(across, down, deep, s2, ax, ay, gxx, gxy, gyy)
    _put(grad_scales, i, gs0, gs1, gs2, inside)

    gu = fx * tl.load(grad_centres + 2 * i, mask=shown, other=0.0)
    gv = fy * tl.load(grad_centres + 2 * i + 1, mask=shown, other=0.0)
    gu += tl.where(tx == u, gtx + htx + ktx, 0.0)
    gv += tl.where(ty == v, gty + hty + kty, 0.0)
    gx, gy = gu * inverse, gv * inverse
    gz = -(gu * u + gv * v + (gax + hax + kax) * ax + (gay + hay + kay) * ay) * inverse
    x, y, z = _to_world(pose, gx, gy, gz)
    _put(grad_means, i, x, y, z, inside)

    # dL/dR = W^T dL/d(W R), column by column.
    n00, n10, n20 = _to_world(pose, gh0, gk0, -gh0 * tx - gk0 * ty)
    n01, n11, n21 = _to_world(pose, gh1, gk1, -gh1 * tx - gk1 * ty)
    n02, n12, n22 = _to_world(pose, gh2, gk2, -gh2 * tx - gk2 * ty)
    w, x, y, z = qw, qx, qy, qz
    gw = 2 * (x * (n21 - n12) + y * (n02 - n20) + z * (n10 - n01))
    gx = 2 * (w * (n21 - n12) - 2 * x * (n11 + n22) + y * (n01 + n10) + z * (n02 + n20))
    gy = 2 * (w * (n02 - n20) + x * (n01 + n10) - 2 * y * (n00 + n22) + z * (n12 + n21))
    gz = 2 * (w * (n10 - n01) + x * (n02 + n20) + y * (n12 + n21) - 2 * z * (n00 + n11))
    along = gw * w + gx * x + gy * y + gz * z  # normalised: no gradient along the quaternion
    tl.store(grad_rotations + 4 * i, (gw - along * w) * shrink, mask=inside)
    tl.store(grad_rotations + 4 * i + 1, (gx - along * x) * shrink, mask=inside)
    tl.store(grad_rotations + 4 * i + 2, (gy - along * y) * shrink, mask=inside)
    tl.store(grad_rotations + 4 * i + 3, (gz - along * z) * shrink, mask=inside)


@triton.jit
def _of_axis(across, down, deep, scale, ax, ay, gxx, gxy, gyy):
    """Gradients through a column (h, k) of H.

    They are of the scale; of the column of W R, along both axes of the picture; of fx / z and
    fy / z; of tx and ty.
    """
    h, k = ax * across * scale, ay * down * scale
    gh, gk = 2 * (gxx * h + gxy * k), 2 * (gxy * h + gyy * k)
    of_scale = gh * ax * across + gk * ay * down
    of_h, of_k = gh * ax * scale, gk * ay * scale
    of_ax, of_ay = gh * across * scale, gk * down * scale
    return of_scale, of_h, of_k, of_ax, of_ay, -of_h * deep, -of_k * deep


@triton.jit
def _to_world(pose, x, y, z):
    """W^T times a vector in camera coordinates."""
    a, b, c = _axis(pose, 0)
    d, e, f = _axis(pose, 1)
    g, h, k = _axis(pose, 2)
    return a * x + d * y + g * z, b * x + e * y + h * z, c * x + f * y + k * z

"""Colours and pixels of voxels with numba.

A frame: each ray walks, shades and composites a few voxels at a time, which never leave the
first-level cache, until nothing shines through. A training: a thread adds up the gradients of its
own voxels only, so that there are no atomics and the sums are the same every time.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numba import get_num_threads, njit, prange
from torch import Tensor

from bench.types import Rays
from methods.kernels.composite import Pixels
from methods.kernels.cpu import f32
from methods.kernels.spherical.cpu import _harmonics as spherical_harmonics
from methods.kernels.voxel_shading import Light
from methods.kernels.voxel_walk import Voxels
from methods.kernels.voxel_walk.cpu import length_of, walk_ray

CHUNK = 64  # rays; small, because those of a row of pixels take very different times
SEGMENTS = 1 << 12  # crossings shaded by a thread at a time
ROUND = 16
"""Voxels that a ray finds at a time: few are walked in vain behind its end."""

f64 = np.float64


def shade_voxels(
    harmonics: Tensor, voxel: Tensor, ray: Tensor, directions: Tensor, grad_buffer: Tensor | None
) -> Tensor:
    """See `methods.kernels.voxel_shading.shade_voxels`."""
    _check_float32(harmonics=harmonics, directions=directions)
    if grad_buffer is not None and not harmonics.requires_grad:
        harmonics = harmonics.detach().requires_grad_()
    return _Shade.apply(harmonics, voxel, ray, directions, grad_buffer)


def render_voxels(
    rays: Rays, voxels: Voxels, light: Light, stop: float, faint: float
) -> tuple[Pixels, Tensor, Tensor]:
    """See `methods.kernels.voxel_shading.render_voxels`."""
    _check_float32(
        origins=rays.origins,
        directions=rays.directions,
        density=light.density,
        harmonics=light.harmonics,
    )
    count = len(rays.origins)
    pixels = Pixels.blank(count, 3)
    crossed, shaded = (torch.zeros(count, dtype=torch.int32) for _ in range(2))
    given = (rays.origins, rays.directions, voxels.bricks, voxels.leaves, voxels.clearance)
    _render(
        *(x.contiguous().numpy() for x in given),
        light.density.detach().contiguous().numpy(),
        light.harmonics.detach().contiguous().numpy(),
        f64(f32(stop)),
        f64(f32(faint)),
        pixels.values.numpy(),
        pixels.depth_sum.numpy(),
        pixels.alpha.numpy(),
        crossed.numpy(),
        shaded.numpy(),
    )
    return pixels, crossed, shaded


def _check_float32(**tensors: Tensor) -> None:
    for name, tensor in tensors.items():
        if tensor.dtype != torch.float32:
            raise ValueError(
                f"backend 'cpu' takes float32, got {name} {tensor.dtype}: use backend='reference'"
            )


class _Shade(torch.autograd.Function):
    @staticmethod
    def forward(ctx, harmonics, voxel, ray, directions, grad_buffer):
        given = [x.detach().contiguous() for x in (voxel, ray, directions)]
        colours = torch.empty(len(voxel), 3)
        _shade(
            harmonics.detach().contiguous().numpy(), *(x.numpy() for x in given), colours.numpy()
        )
        ctx.save_for_backward(*given, colours)
        ctx.shape, ctx.grad_buffer = harmonics.shape, grad_buffer
        return colours

    @staticmethod
    def backward(ctx, grad):
        *given, colours = ctx.saved_tensors
        buffer = ctx.grad_buffer
        target = torch.zeros(ctx.shape) if buffer is None else buffer
        slope = grad * colours * (1 - colours)  # of the sigmoid
        parts = 4 * get_num_threads()
        _scatter(*(x.numpy() for x in (*given, slope.contiguous(), target)), parts)
        return target if buffer is None else None, None, None, None, None


@njit(cache=True)
def _sigmoid(x):
    return f32(1) / (f32(1) + f32(math.exp(-x)))


@njit(cache=True)
def _colour(coefficients, basis):
    size = coefficients.shape[0]
    red, green, blue = f32(0), f32(0), f32(0)
    for k in range(size):
        red += basis[k] * coefficients[k, 0]
        green += basis[k] * coefficients[k, 1]
        blue += basis[k] * coefficients[k, 2]
    return _sigmoid(red), _sigmoid(green), _sigmoid(blue)


@njit(cache=True, parallel=True)
def _shade(harmonics, voxel, ray, directions, colours):
    total = len(voxel)
    for chunk in prange((total + SEGMENTS - 1) // SEGMENTS):
        basis = np.empty(16, np.float32)
        last = -1
        for i in range(chunk * SEGMENTS, min(total, (chunk + 1) * SEGMENTS)):
            if ray[i] != last:
                last = ray[i]
                spherical_harmonics(directions[last], basis)
            colours[i, 0], colours[i, 1], colours[i, 2] = _colour(harmonics[voxel[i]], basis)


@njit(cache=True, parallel=True)
def _scatter(voxel, ray, directions, slope, target, parts):
    """Adjoint of the sums of `_shade`: target[voxel] += Y(d) slope."""
    size = target.shape[1]
    for part in prange(parts):
        basis = np.empty(16, np.float32)
        last = -1
        for i in range(len(voxel)):
            if voxel[i] % parts != part:
                continue
            if ray[i] != last:
                last = ray[i]
                spherical_harmonics(directions[last], basis)
            for k in range(size):
                for channel in range(3):
                    target[voxel[i], k, channel] += basis[k] * slope[i, channel]


@njit(cache=True, parallel=True)
def _render(
    origins,
    directions,
    bricks,
    leaves,
    clearance,
    density,
    harmonics,
    stop,
    faint,
    values,
    depth_sum,
    alpha,
    crossed,
    shaded,
):
    rays = len(origins)
    for chunk in prange((rays + CHUNK - 1) // CHUNK):
        near, far = np.empty(ROUND, np.float32), np.empty(ROUND, np.float32)
        voxel = np.empty(ROUND, np.int32)
        unit, basis = np.empty(3, np.float32), np.empty(16, np.float32)
        for ray in range(chunk * CHUNK, min(rays, (chunk + 1) * CHUNK)):
            origin, direction = origins[ray], directions[ray]
            length = length_of(direction[0], direction[1], direction[2])
            red, green, blue, depth, transmittance = 0.0, 0.0, 0.0, 0.0, 1.0
            start, steps, colours = f32(0), 0, 0
            while start < np.inf and transmittance > stop:
                count, start = walk_ray(
                    origin, direction, bricks, leaves, clearance, start, ROUND, near, far, voxel
                )
                for i in range(count):
                    if transmittance <= stop:
                        break
                    steps += 1
                    sigma = density[voxel[i]]
                    if sigma <= 0:
                        continue
                    delta = (far[i] - near[i]) * length
                    weight = transmittance * -math.expm1(-f64(sigma * delta))
                    transmittance -= weight
                    depth += weight * f64((near[i] + far[i]) * f32(0.5))
                    if weight > faint:
                        if colours == 0:
                            for axis in range(3):
                                unit[axis] = direction[axis] / length
                            spherical_harmonics(unit, basis)
                        colours += 1
                        r, g, b = _colour(harmonics[voxel[i]], basis)
                        red += weight * f64(r)
                        green += weight * f64(g)
                        blue += weight * f64(b)
            values[ray, 0], values[ray, 1], values[ray, 2] = red, green, blue
            depth_sum[ray], alpha[ray] = depth, 1 - transmittance
            crossed[ray], shaded[ray] = steps, colours

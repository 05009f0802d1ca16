"""Voxels with numba. Rendering does not store crossings: each ray walks, shades and composites a
few voxels at a time, which never leave the first-level cache. In training, coefficients are read in
place; in the backward pass each thread sums the gradients of its own voxels only, so that there are
no atomics and results are repeatable.
"""

import math

import numpy as np
import torch
from numba import get_num_threads, prange
from torch import Tensor
from torch.nn.functional import normalize

from bench.types import Rays
from methods.kernels.cpu import (
    arrays,
    check_float32,
    f32,
    f64,
    jit,
    prefetch,
    prefetch_row,
    sigmoid,
    u64,
)
from methods.kernels.shade.cpu import harmonics as basis_of
from methods.kernels.spherical import CHANNELS
from methods.kernels.types import Pixels
from methods.kernels.voxel_walk import Voxels
from methods.kernels.voxel_walk.cpu import length_of, maps_of, walk_ray
from methods.plenoctree.kernels.voxel_light import Light

RAYS = 64  # rays of a chunk

ROUND = 16  # voxels that a ray finds at a time; few, so that few behind its end are wasted

CHUNK = 1 << 10  # voxels at a time, whose colours stay in the first-level cache

NEAR = 64
"""Voxels in a row that one thread owns: two threads would take a cache line from each other."""

AHEAD = 16  # voxels between the one that is asked for and the one that is read

ONE, TWO, THREE = u64(1), u64(2), u64(3)


def render_voxels(
    rays: Rays, voxels: Voxels, light: Light, stop: float, faint: float
) -> tuple[Pixels, Tensor, Tensor]:
    check_float32(rays.origins, rays.directions, light.density, light.harmonics)
    pixels = Pixels.blank(len(rays.origins), 3)
    crossed, shaded = torch.zeros(2, len(rays.origins), dtype=torch.int32)
    basis = basis_of(normalize(rays.directions, dim=1))
    _render(
        tuple(arrays(rays.origins, rays.directions, basis.view(-1))),
        tuple(arrays(light.density, light.harmonics.reshape(-1))),
        light.harmonics.shape[1],
        maps_of(voxels),
        (f64(f32(stop)), f64(f32(faint))),
        tuple(arrays(*pixels.columns, crossed, shaded)),
    )
    return pixels, crossed, shaded


def shade_voxels(
    harmonics: Tensor, voxel: Tensor, ray: Tensor, directions: Tensor, grad_buffer: Tensor | None
) -> Tensor:
    check_float32(harmonics, directions)
    return _ShadeVoxels.apply(harmonics, voxel, ray, basis_of(directions), grad_buffer)


class _ShadeVoxels(torch.autograd.Function):
    @staticmethod
    def forward(ctx, harmonics, voxel, ray, basis, grad_buffer):
        given = [x.detach().contiguous() for x in (voxel, ray, basis.view(-1))]
        colours = torch.empty(len(voxel), 3)
        _shade(*arrays(harmonics.reshape(-1), *given), harmonics.shape[1], colours.numpy())
        ctx.save_for_backward(*given, colours)
        ctx.shape, ctx.grad_buffer = harmonics.shape, grad_buffer
        return colours

    @staticmethod
    def backward(ctx, grad):
        buffer = ctx.grad_buffer
        target = torch.zeros(ctx.shape) if buffer is None else buffer
        parts = 1 << (get_num_threads() - 1).bit_length()
        _scatter(*arrays(*ctx.saved_tensors, grad, target.view(-1)), ctx.shape[1], parts)
        return target if buffer is None else None, None, None, None, None


@jit(error_model="numpy")
def _weighted_sum(harmonics, voxel, basis, ray, terms):
    """Three colours of a voxel as a ray sees it, before the sigmoid; `harmonics` and `basis` are
    flat."""
    at, of = u64(voxel * terms * 3), u64(ray * CHANNELS)
    red, green, blue = f32(0), f32(0), f32(0)
    for _ in range(terms):
        red += basis[of] * harmonics[at]
        green += basis[of] * harmonics[at + ONE]
        blue += basis[of] * harmonics[at + TWO]
        at, of = at + THREE, of + ONE
    return red, green, blue


@jit(parallel=True, error_model="numpy")
def _shade(harmonics, voxel, ray, basis, terms, colours):
    """`harmonics` and `basis` are flat."""
    total = len(voxel)
    for chunk in prange((total + CHUNK - 1) // CHUNK):
        first, end = chunk * CHUNK, min(total, (chunk + 1) * CHUNK)
        for i in range(first, end):
            prefetch_row(harmonics, voxel[min(i + AHEAD, end - 1)] * terms * 3, terms * 3)
            colours[i, 0], colours[i, 1], colours[i, 2] = _weighted_sum(
                harmonics, voxel[i], basis, ray[i], terms
            )
        shown = colours[first:end].reshape(-1)
        for j in range(len(shown)):  # by themselves, in whole vectors
            shown[j] = sigmoid(shown[j])


@jit(parallel=True)
def _scatter(voxel, ray, basis, colours, grad, target, terms, parts):
    """Adjoint of `_shade`: target[voxel] += Y(d) times the gradient before the sigmoid. `basis` and
    `target` are flat, `parts` a power of two."""
    for part in prange(parts):
        for i in range(len(voxel)):
            if (voxel[i] // NEAR) & (parts - 1) == part:
                red = grad[i, 0] * colours[i, 0] * (f32(1) - colours[i, 0])
                green = grad[i, 1] * colours[i, 1] * (f32(1) - colours[i, 1])
                blue = grad[i, 2] * colours[i, 2] * (f32(1) - colours[i, 2])
                at, of = u64(voxel[i] * terms * 3), u64(ray[i] * CHANNELS)
                for _ in range(terms):
                    value = basis[of]
                    target[at] += value * red
                    target[at + ONE] += value * green
                    target[at + TWO] += value * blue
                    at, of = at + THREE, of + ONE


@jit(parallel=True)
def _render(rays, light, terms, maps, bounds, out):
    """Flat: the harmonics' values in the directions of rays, and the coefficients of the light."""
    origins, directions, basis = rays
    density, harmonics = light
    stop, faint = bounds
    values, depth_sum, alpha, crossed, shaded = out
    total = len(origins)
    for chunk in prange((total + RAYS - 1) // RAYS):
        near, far = np.empty(ROUND, np.float32), np.empty(ROUND, np.float32)
        voxel = np.empty(ROUND, np.int32)
        for ray in range(chunk * RAYS, min(total, (chunk + 1) * RAYS)):
            origin, direction = origins[ray], directions[ray]
            length = length_of(direction[0], direction[1], direction[2])
            red, green, blue, depth, transmittance = 0.0, 0.0, 0.0, 0.0, 1.0
            start, steps, colours = f32(0), 0, 0
            while start < np.inf and transmittance > stop:
                room = near, far, voxel
                count, start = walk_ray(origin, direction, maps, start, ROUND, room)
                # All that may be read is asked for before anything is waited for.
                for i in range(count):
                    prefetch(density, np.int64(voxel[i]))
                    prefetch_row(harmonics, voxel[i] * terms * 3, terms * 3)
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
                        colours += 1
                        r, g, b = _weighted_sum(harmonics, voxel[i], basis, ray, terms)
                        red += weight * f64(sigmoid(r))
                        green += weight * f64(sigmoid(g))
                        blue += weight * f64(sigmoid(b))
            values[ray, 0], values[ray, 1], values[ray, 2] = red, green, blue
            depth_sum[ray], alpha[ray] = depth, 1 - transmittance
            crossed[ray], shaded[ray] = steps, colours

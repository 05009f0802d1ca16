"""Colours of voxels with numba: coefficients are read in place, without a copy.

In the backward pass each thread sums the gradients of its own voxels only, so that there are no
atomics and results are repeatable.
"""

from __future__ import annotations

import torch
from numba import get_num_threads, njit, prange
from torch import Tensor

from methods.kernels.cpu import f32, prefetch_row, sigmoid, u64
from methods.kernels.spherical import CHANNELS, spherical_harmonics

CHUNK = 1 << 10
"""Voxels at a time, whose colours stay in the first-level cache."""

NEAR = 64
"""Voxels in a row that one thread owns: two threads would take a cache line from each other."""

AHEAD = 16
"""Voxels between the one that is asked for and the one that is read."""

ONE, TWO, THREE = u64(1), u64(2), u64(3)


def shade_voxels(
    harmonics: Tensor, voxel: Tensor, ray: Tensor, directions: Tensor, grad_buffer: Tensor | None
) -> Tensor:
    """See `methods.kernels.voxel_shading.shade_voxels`."""
    if not harmonics.dtype == directions.dtype == torch.float32:
        raise ValueError(
            f"backend 'cpu' shades float32, got harmonics {harmonics.dtype} and directions "
            f"{directions.dtype}: use backend='reference'"
        )
    basis = spherical_harmonics(directions, backend="cpu")
    return _Shade.apply(harmonics, voxel, ray, basis, grad_buffer)


class _Shade(torch.autograd.Function):
    @staticmethod
    def forward(ctx, harmonics, voxel, ray, basis, grad_buffer):
        given = [x.detach().contiguous() for x in (voxel, ray, basis.view(-1))]
        colours = torch.empty(len(voxel), 3)
        flat = harmonics.detach().reshape(-1)
        _shade(flat.numpy(), *(x.numpy() for x in given), harmonics.shape[1], colours.numpy())
        ctx.save_for_backward(*given, colours)
        ctx.shape, ctx.grad_buffer = harmonics.shape, grad_buffer
        return colours

    @staticmethod
    def backward(ctx, grad):
        *given, colours = ctx.saved_tensors
        buffer = ctx.grad_buffer
        target = torch.zeros(ctx.shape) if buffer is None else buffer
        parts = 1 << (get_num_threads() - 1).bit_length()
        given += [colours, grad.contiguous(), target.view(-1)]
        _scatter(*(x.numpy() for x in given), ctx.shape[1], parts)
        return target if buffer is None else None, None, None, None, None


@njit(cache=True, error_model="numpy")
def weighted_sum(harmonics, voxel, basis, ray, terms):
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


@njit(cache=True, parallel=True, error_model="numpy")
def _shade(harmonics, voxel, ray, basis, terms, colours):
    """`harmonics` and `basis` are flat."""
    total = len(voxel)
    for chunk in prange((total + CHUNK - 1) // CHUNK):
        first, end = chunk * CHUNK, min(total, (chunk + 1) * CHUNK)
        for i in range(first, end):
            prefetch_row(harmonics, voxel[min(i + AHEAD, end - 1)] * terms * 3, terms * 3)
            colours[i, 0], colours[i, 1], colours[i, 2] = weighted_sum(
                harmonics, voxel[i], basis, ray[i], terms
            )
        shown = colours[first:end].reshape(-1)
        for j in range(len(shown)):  # by themselves, in whole vectors
            shown[j] = sigmoid(shown[j])


@njit(cache=True, parallel=True)
def _scatter(voxel, ray, basis, colours, grad, target, terms, parts):
    """Adjoint of `_shade`: target[voxel] += Y(d) times the gradient before the sigmoid.

    `basis` and `target` are flat, `parts` a power of two.
    """
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

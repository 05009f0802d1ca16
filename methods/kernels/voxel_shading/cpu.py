"""Colours of voxels with numba: coefficients are read in place, without a copy.

In the backward pass each thread sums the gradients of its own voxels only, so that there are no
atomics and results are repeatable.
"""

from __future__ import annotations

import torch
from numba import get_num_threads, njit, prange
from torch import Tensor

from methods.kernels.cpu import f32, sigmoid
from methods.kernels.spherical import spherical_harmonics

CHUNK = 1 << 12  # voxels


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
        given = [x.detach().contiguous() for x in (voxel, ray, basis)]
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


@njit(cache=True, parallel=True)
def _shade(harmonics, voxel, ray, basis, colours):
    total, size = len(voxel), harmonics.shape[1]
    for chunk in prange((total + CHUNK - 1) // CHUNK):
        for i in range(chunk * CHUNK, min(total, (chunk + 1) * CHUNK)):
            coefficients, values = harmonics[voxel[i]], basis[ray[i]]
            red, green, blue = f32(0), f32(0), f32(0)
            for k in range(size):
                red += values[k] * coefficients[k, 0]
                green += values[k] * coefficients[k, 1]
                blue += values[k] * coefficients[k, 2]
            colours[i, 0], colours[i, 1], colours[i, 2] = (
                sigmoid(red),
                sigmoid(green),
                sigmoid(blue),
            )


@njit(cache=True, parallel=True)
def _scatter(voxel, ray, basis, slope, target, parts):
    """Adjoint of the sums of `_shade`: target[voxel] += Y(d) slope."""
    size = target.shape[1]
    for part in prange(parts):
        for i in range(len(voxel)):
            if voxel[i] % parts == part:
                for k in range(size):
                    for channel in range(3):
                        target[voxel[i], k, channel] += basis[ray[i], k] * slope[i, channel]

"""Compositing with numba: one ray at a time, front to back, until it is opaque.

The transmittance is updated by T_{i+1} = T_i - w_i. Transmittance and sums are float64, because in
float32 a product of many equal factors near 1 drifts: all are rounded the same way.
"""

import math

import numpy as np
import torch
from numba import prange
from torch import Tensor

from methods.kernels.cpu import arrays, check_float32, f32, f64, jit
from methods.kernels.types import Intervals, Pixels

CHUNK = 64  # rays


def composite(
    sigma: Tensor, values: Tensor, intervals: Intervals, stop: float, carry: Pixels | None
) -> Pixels:
    check_float32(sigma, values)
    samples = intervals.t, intervals.delta, intervals.offsets
    return Pixels(*_Composite.apply(sigma, values, *samples, stop, carry))


def visibility(
    sigma: Tensor, intervals: Intervals, stop: float, front: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    weights, left = torch.zeros(len(sigma)), torch.empty(len(front))
    counts = torch.empty(len(front), dtype=torch.int64)
    samples = arrays(sigma, intervals.delta, intervals.offsets, front)
    _light(*samples, f32(stop), *arrays(weights, counts, left))
    return weights, counts, left


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(ctx, sigma, values, t, delta, offsets, stop, carry):
        rays, channels = len(offsets) - 1, values.shape[1]
        pixels = Pixels.blank(rays, channels) if carry is None else carry.copy()
        front = 1 - pixels.alpha
        samples = [x.contiguous() for x in (sigma, values, t, delta, offsets)]
        learns = any(ctx.needs_input_grad)
        opacity = torch.empty(len(sigma) if learns else 0, dtype=torch.float64)
        _forward(*arrays(*samples), f32(stop), *arrays(front, *pixels.columns, opacity))
        ctx.save_for_backward(*samples[1:], front, opacity)
        ctx.stop = stop
        return pixels.columns

    @staticmethod
    def backward(ctx, *grads):
        *samples, front, opacity = ctx.saved_tensors
        results = torch.zeros(len(opacity)), torch.zeros_like(samples[0])
        light = arrays(front, *grads)
        _backward(*arrays(opacity, *samples), f32(ctx.stop), tuple(light), *arrays(*results))
        return *results, None, None, None, None, None


@jit()
def _opacity(sigma, delta):
    # A sample of length 0 has opacity 0 even at infinite density (avoids inf * 0).
    return -math.expm1(-f64(sigma * delta)) if delta > 0 else 0.0


@jit(parallel=True)
def _forward(sigma, values, t, delta, offsets, stop, front, out, depth_sum, alpha, opacity):
    """`opacity` keeps the opacities of samples for `_backward`, unless it is empty."""
    rays, channels = out.shape
    for chunk in prange((rays + CHUNK - 1) // CHUNK):
        sums = np.empty(channels)
        for ray in range(chunk * CHUNK, min(rays, (chunk + 1) * CHUNK)):
            sums[:] = out[ray]
            depth, transmittance = f64(depth_sum[ray]), f64(front[ray])
            for i in range(offsets[ray], offsets[ray + 1]):
                if transmittance <= stop:
                    break
                own = _opacity(sigma[i], delta[i])
                if len(opacity):
                    opacity[i] = own
                weight = transmittance * own
                for channel in range(channels):
                    sums[channel] += weight * values[i, channel]
                depth += weight * t[i]
                transmittance -= weight
            out[ray] = sums
            depth_sum[ray] = depth
            alpha[ray] += f64(front[ray]) - transmittance


@jit(parallel=True)
def _light(sigma, delta, offsets, front, stop, weights, counts, left):
    for ray in prange(len(offsets) - 1):
        transmittance = f64(front[ray])
        i = offsets[ray]
        while i < offsets[ray + 1] and transmittance > stop:
            weight = transmittance * _opacity(sigma[i], delta[i])
            weights[i] = weight
            transmittance -= weight
            i += 1
        counts[ray], left[ray] = i - offsets[ray], transmittance


@jit(parallel=True)
def _backward(opacity, values, t, delta, offsets, stop, light, grad_sigma, grad_values):
    """With g_i = dL/dw_i and T_{i+1} = T_i (1 - alpha_i):

    dL/dsigma_i = delta_i (T_{i+1} g_i - sum_{j > i} w_j g_j).
    """
    front, grad_out, grad_depth, grad_alpha = light
    channels = values.shape[1]
    for ray in prange(len(offsets) - 1):
        behind = 0.0  # sum of w_j g_j over samples behind i; at first over all
        transmittance = f64(front[ray])
        end = offsets[ray]
        while end < offsets[ray + 1] and transmittance > stop:
            weight = transmittance * opacity[end]
            gain = grad_depth[ray] * t[end] + grad_alpha[ray]
            for channel in range(channels):
                gain += grad_out[ray, channel] * values[end, channel]
                grad_values[end, channel] = weight * grad_out[ray, channel]
            # Stored here until the second pass, which needs gain and weight again.
            grad_sigma[end] = gain
            behind += weight * gain
            transmittance -= weight
            end += 1
        transmittance = f64(front[ray])
        for i in range(offsets[ray], end):
            gain = grad_sigma[i]
            weight = transmittance * opacity[i]
            behind -= weight * gain
            transmittance -= weight
            grad_sigma[i] = delta[i] * (transmittance * gain - behind)

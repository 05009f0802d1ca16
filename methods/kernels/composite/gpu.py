"""Compositing with Triton: one program per ray, which processes its samples block by block.

Within a block, transmittance is the exponential of a cumulative sum. A ray ends after the first
block behind which it is opaque.
"""

import torch
import triton
import triton.language as tl
from torch import Tensor

from methods.kernels.gpu import check_float32, launch, opacity
from methods.kernels.types import Intervals, Pixels

BLOCK = tl.constexpr(64)  # samples
OPAQUE = tl.constexpr(128.0)
"""Optical thickness at which the transmittance is 0 in float32; clamping to it avoids inf."""


def composite(
    sigma: Tensor, values: Tensor, intervals: Intervals, stop: float, carry: Pixels | None
) -> Pixels:
    t, delta = intervals.t, intervals.delta
    check_float32(sigma=sigma, values=values, t=t, delta=delta)
    return Pixels(*_TritonComposite.apply(sigma, values, t, delta, intervals.offsets, stop, carry))


def visibility(
    sigma: Tensor, intervals: Intervals, stop: float, front: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    check_float32(sigma=sigma, delta=intervals.delta, front=front)
    samples = [x.contiguous() for x in (sigma, intervals.delta, intervals.offsets, front)]
    counts, left = samples[2].new_empty(len(front)), torch.empty_like(samples[3])
    found = torch.zeros_like(samples[0]), counts, left
    launch(_light, (len(front),), *samples, stop, *found, num_warps=1)
    return found


class _TritonComposite(torch.autograd.Function):
    @staticmethod
    def forward(ctx, sigma, values, t, delta, offsets, stop, carry):
        rays, channels = len(offsets) - 1, values.shape[1]
        pixels = [sigma.new_empty(shape) for shape in ((rays, channels), rays, rays)]
        before = [None] * 3 if carry is None else [x.contiguous() for x in carry.columns]
        samples = [x.contiguous() for x in (sigma, values, t, delta, offsets)]
        launch(_forward, (rays,), *samples, *before, stop, *pixels, CHANNELS=channels, num_warps=1)
        ctx.save_for_backward(*samples, before[2])
        ctx.stop = stop
        return tuple(pixels)

    @staticmethod
    def backward(ctx, *grads):
        *samples, before = ctx.saved_tensors
        sizes = samples[0].numel(), samples[1].numel()
        grad_sigma, grad_samples = samples[0].new_zeros(sum(sizes)).split(sizes)
        grad_samples = grad_samples.view_as(samples[1])
        given = *samples, before, ctx.stop, *(x.contiguous() for x in grads)
        rays, channels = len(samples[4]) - 1, samples[1].shape[1]
        results = grad_sigma, grad_samples
        launch(_backward, (rays,), *given, *results, CHANNELS=channels, num_warps=1)
        return grad_sigma, grad_samples, None, None, None, None, None


@triton.jit
def _thickness(sigma, delta, i, there):
    """Optical thickness of samples, at most `OPAQUE`; NaN stays NaN. A sample of length 0 has
    thickness 0 even at infinite density (avoids inf * 0)."""
    length = tl.load(delta + i, mask=there, other=0.0)
    tau = tl.load(sigma + i, mask=there, other=0.0) * length
    tau = tl.where(tau > OPAQUE, OPAQUE, tau)
    return tl.where(length > 0, tau, 0.0)


@triton.jit
def _block(sigma, delta, first, i, inside, light, stop):
    """Weights of the samples `i`, the first of which is `first`. Also which of them still get
    light, the transmittance behind each, and that behind all. No sample behind a NaN gets light."""
    in_front = _thickness(sigma, delta, i - 1, inside & (i > first))
    tau = _thickness(sigma, delta, i, inside)
    before = light * tl.exp(-tl.cumsum(in_front, 0))
    lit = inside & (before > stop)
    weight = tl.where(lit, before * opacity(tau), 0.0)
    return weight, lit, before * tl.exp(-tau), light * tl.exp(-tl.sum(tau, 0))


@triton.jit
def _number(column, ray):
    """That of a ray in a column, 0 without one."""
    return tl.zeros([], tl.float32) if column is None else tl.load(column + ray)


@triton.jit
def _forward(
    sigma,
    values,
    t,
    delta,
    offsets,
    values_before,
    depth_before,
    alpha_before,
    stop,
    out,
    depth_sum,
    alpha,
    CHANNELS: tl.constexpr,
):
    ray = tl.program_id(0).to(tl.int64)
    first, end = tl.load(offsets + ray), tl.load(offsets + ray + 1)
    channel, there = _channels(CHANNELS)
    sums = tl.zeros_like(channel).to(tl.float32)
    if values_before is not None:
        sums = tl.load(values_before + ray * CHANNELS + channel, mask=there, other=0.0)
    depth, covered = _number(depth_before, ray), _number(alpha_before, ray)
    light = 1 - covered
    while (first < end) & (light > stop):
        i = first + tl.arange(0, BLOCK)
        weight, lit, _, light = _block(sigma, delta, first, i, i < end, light, stop)
        rows = values + i[:, None] * CHANNELS + channel[None, :]
        shown = tl.load(rows, mask=lit[:, None] & there[None, :], other=0.0)
        sums += tl.sum(weight[:, None] * shown, 0)
        depth += tl.sum(weight * tl.load(t + i, mask=lit, other=0.0), 0)
        covered += tl.sum(weight, 0)
        first += BLOCK
    tl.store(out + ray * CHANNELS + channel, sums, mask=there)
    tl.store(depth_sum + ray, depth)
    tl.store(alpha + ray, covered)


@triton.jit
def _light(sigma, delta, offsets, front, stop, weights, counts, left):
    ray = tl.program_id(0).to(tl.int64)
    first, end = tl.load(offsets + ray), tl.load(offsets + ray + 1)
    light, count = tl.load(front + ray), tl.zeros([], tl.int64)
    last = light
    while (first < end) & (light > stop):
        i = first + tl.arange(0, BLOCK)
        found, lit, behind, light = _block(sigma, delta, first, i, i < end, light, stop)
        tl.store(weights + i, found, mask=i < end)
        count += tl.sum(lit.to(tl.int64), 0)
        last = tl.min(tl.where(lit, behind, last), 0)
        first += BLOCK
    tl.store(counts + ray, count)
    tl.store(left + ray, last)


@triton.jit
def _channels(CHANNELS: tl.constexpr):
    """Numbers of the channels, up to a power of 2, and which of them are there."""
    channel = tl.arange(0, triton.next_power_of_2(CHANNELS))
    return channel, channel < CHANNELS


@triton.jit
def _gain(values, t, i, lit, shine, of_depth, of_alpha, CHANNELS: tl.constexpr):
    """g_i = dL/dw_i of samples that get light; 0 for others."""
    channel, there = _channels(CHANNELS)
    rows = values + i[:, None] * CHANNELS + channel[None, :]
    shown = tl.load(rows, mask=lit[:, None] & there[None, :], other=0.0)
    where = tl.load(t + i, mask=lit, other=0.0)
    gain = of_depth * where + of_alpha + tl.sum(shown * shine[None, :], 1)
    return tl.where(lit, gain, 0.0)


@triton.jit
def _backward(
    sigma,
    values,
    t,
    delta,
    offsets,
    alpha_before,
    stop,
    grad_out,
    grad_depth,
    grad_alpha,
    grad_sigma,
    grad_values,
    CHANNELS: tl.constexpr,
):
    """With g_i = dL/dw_i and T_{i+1} = T_i (1 - alpha_i):

    dL/dsigma_i = delta_i (T_{i+1} g_i - sum_{j > i} w_j g_j).
    """
    ray = tl.program_id(0).to(tl.int64)
    begin, end = tl.load(offsets + ray), tl.load(offsets + ray + 1)
    channel, there = _channels(CHANNELS)
    shine = tl.load(grad_out + ray * CHANNELS + channel, mask=there, other=0.0)
    of_depth, of_alpha = tl.load(grad_depth + ray), tl.load(grad_alpha + ray)

    first, light, rest = begin, 1 - _number(alpha_before, ray), 0.0
    while (first < end) & (light > stop):
        i = first + tl.arange(0, BLOCK)
        weight, lit, _, light = _block(sigma, delta, first, i, i < end, light, stop)
        gain = _gain(values, t, i, lit, shine, of_depth, of_alpha, CHANNELS)
        rest += tl.sum(weight * gain, 0)
        rows = grad_values + i[:, None] * CHANNELS + channel[None, :]
        tl.store(rows, weight[:, None] * shine[None, :], mask=lit[:, None] & there[None, :])
        first += BLOCK

    # `rest` is now the sum over all samples; minus those passed, it is the sum behind.
    first, light = begin, 1 - _number(alpha_before, ray)
    while (first < end) & (light > stop):
        i = first + tl.arange(0, BLOCK)
        weight, lit, behind, light = _block(sigma, delta, first, i, i < end, light, stop)
        gain = _gain(values, t, i, lit, shine, of_depth, of_alpha, CHANNELS)
        slope = behind * gain - (rest - tl.cumsum(weight * gain, 0))
        tl.store(grad_sigma + i, tl.load(delta + i, mask=lit, other=0.0) * slope, mask=lit)
        rest -= tl.sum(weight * gain, 0)
        first += BLOCK

"""Compositing in plain torch: rays padded to the longest, transmittance by a cumulative sum."""

import torch
from torch import Tensor
from torch.nn import functional

from bench.types import ThreeTensors, TwoTensors
from methods.kernels.types import Intervals, Pixels


def composite(
    sigma: Tensor, values: Tensor, intervals: Intervals, stop: float, carry: Pixels | None
) -> Pixels:
    slots = _padded_rays(intervals)
    front = sigma.new_ones(len(slots[0])) if carry is None else 1 - carry.alpha
    weight, _, _ = _padded_weights(sigma, intervals.delta, slots, stop, front)
    sums = (
        (weight[..., None] * _padded(values, slots)).sum(dim=1),
        (weight * _padded(intervals.t, slots)).sum(dim=1),
        weight.sum(dim=1),
    )
    return Pixels(*(sums if carry is None else map(torch.add, carry.columns, sums)))


def visibility(sigma: Tensor, intervals: Intervals, stop: float, front: Tensor) -> ThreeTensors:
    slots, starts = _padded_rays(intervals), intervals.offsets[:-1]
    weight, lit, tau = _padded_weights(sigma, intervals.delta, slots, stop, front)
    ray = torch.arange(len(starts), device=sigma.device).repeat_interleave(
        intervals.offsets.diff(), output_size=len(sigma)
    )
    weights = weight[ray, torch.arange(len(sigma), device=sigma.device) - starts[ray]]
    seen = lit & slots[0]
    left = front * torch.exp(-torch.where(seen, tau, 0).sum(dim=1))
    return weights, seen.sum(dim=1), left


def _padded_rays(intervals: Intervals) -> TwoTensors:
    """Mask of the [R, N] slots that hold a sample (N: longest ray), and its index, 0 elsewhere."""
    offsets, longest = intervals.offsets, intervals.longest
    counts = offsets.diff()
    if longest is None:
        longest = int(counts.max()) if len(counts) else 0
    slot = torch.arange(longest, device=offsets.device)
    present = slot < counts[:, None]
    return present, torch.where(present, offsets[:-1, None] + slot, 0)


def _padded(samples: Tensor, slots: TwoTensors) -> Tensor:
    """Samples [S, ...] as [R, N, ...], 0 in empty slots."""
    present, index = slots
    mask = present.reshape(*present.shape, *(1,) * (samples.dim() - 1))
    return torch.where(mask, samples[index], 0) if len(samples) else samples[index]


def _padded_weights(
    sigma: Tensor, delta: Tensor, slots: TwoTensors, stop: float, front: Tensor
) -> ThreeTensors:
    """Weights [R, N] of samples, which of them get light, and their optical thickness."""
    # A sample of length 0 has thickness 0 even at infinite density (avoids inf * 0).
    tau = _padded(torch.where(delta > 0, sigma * delta, 0), slots)
    # Shifted rather than subtracted: behind an infinite thickness, inf - inf would be NaN.
    in_front = functional.pad(tau, (1, 0)).cumsum(dim=1)[:, :-1]
    transmittance = front[:, None] * torch.exp(-in_front)
    lit = transmittance > stop
    return torch.where(lit, transmittance * -torch.expm1(-tau), 0), lit, tau

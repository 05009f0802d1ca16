"""Compositing in plain torch: rays padded to the longest, transmittance by a cumulative sum."""

from __future__ import annotations

import torch
from torch import Tensor

from methods.kernels.composite import Pixels


def composite(
    sigma: Tensor,
    values: Tensor,
    t: Tensor,
    delta: Tensor,
    offsets: Tensor,
    stop: float,
    carry: Pixels | None,
) -> Pixels:
    """See `methods.kernels.composite.composite`."""
    counts = offsets.diff()
    slot = torch.arange(int(counts.max()) if len(counts) else 0, device=sigma.device)
    present = slot < counts[:, None]  # [R, N]
    index = torch.where(present, offsets[:-1, None] + slot, 0)

    def padded(samples: Tensor) -> Tensor:
        mask = present.reshape(*present.shape, *(1,) * (samples.dim() - 1))
        return torch.where(mask, samples[index], 0) if len(samples) else samples[index]

    # A sample without length is without matter, however dense: 0, not inf * 0.
    tau = padded(torch.where(delta > 0, sigma * delta, 0))  # [R, N]
    # Shifted rather than subtracted: behind an infinite thickness, inf - inf would be no number.
    before = torch.nn.functional.pad(tau, (1, 0)).cumsum(dim=1)[:, :-1]
    front = 1 if carry is None else (1 - carry.alpha)[:, None]
    transmittance = front * torch.exp(-before)
    weight = torch.where(transmittance > stop, transmittance * -torch.expm1(-tau), 0)

    rays = Pixels(
        (weight[..., None] * padded(values)).sum(dim=1),
        (weight * padded(t)).sum(dim=1),
        weight.sum(dim=1),
    )
    if carry is None:
        return rays
    return Pixels(
        carry.values + rays.values, carry.depth_sum + rays.depth_sum, carry.alpha + rays.alpha
    )

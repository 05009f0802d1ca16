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
    present, index = _padded_rays(offsets)

    def padded(samples: Tensor) -> Tensor:
        mask = present.reshape(*present.shape, *(1,) * (samples.dim() - 1))
        return torch.where(mask, samples[index], 0) if len(samples) else samples[index]

    tau = padded(_thickness(sigma, delta))  # [R, N]
    front = 1 if carry is None else (1 - carry.alpha)[:, None]
    transmittance = front * _transmittance(tau)
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


def visible_counts(sigma: Tensor, delta: Tensor, offsets: Tensor, stop: float) -> Tensor:
    """See `methods.kernels.composite.visible_counts`."""
    present, index = _padded_rays(offsets)
    if not len(sigma):
        return offsets.diff()
    tau = torch.where(present, _thickness(sigma, delta)[index], 0)
    return ((_transmittance(tau) > stop) & present).sum(dim=1)


def _padded_rays(offsets: Tensor) -> tuple[Tensor, Tensor]:
    """Which of [R, N] slots hold a sample, N of the longest ray, and which sample (0 elsewhere)."""
    counts = offsets.diff()
    slot = torch.arange(int(counts.max()) if len(counts) else 0, device=offsets.device)
    present = slot < counts[:, None]
    return present, torch.where(present, offsets[:-1, None] + slot, 0)


def _thickness(sigma: Tensor, delta: Tensor) -> Tensor:
    # A sample without length is without matter, however dense: 0, not inf * 0.
    return torch.where(delta > 0, sigma * delta, 0)


def _transmittance(tau: Tensor) -> Tensor:
    """In front of each sample, of optical thicknesses [R, N]."""
    # Shifted rather than subtracted: behind an infinite thickness, inf - inf would be no number.
    return torch.exp(-torch.nn.functional.pad(tau, (1, 0)).cumsum(dim=1)[:, :-1])

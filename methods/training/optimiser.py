"""Steps of an optimiser at a given learning rate."""

from __future__ import annotations

import math

import torch


def cosine(done: float, final: float, half_waves: int = 1) -> float:
    """Share of the learning rate after a share `done` of the steps: from 1 to `final`.

    One half wave falls all the way; three fall, rise to 1 again, and fall.
    """
    return final + (1 - final) * 0.5 * (1 + math.cos(half_waves * math.pi * done))


def step_at(optimiser: torch.optim.Optimizer, rate: float) -> None:
    """A step at learning rate `rate`; the gradients are used up."""
    for group in optimiser.param_groups:
        group["lr"] = rate
    optimiser.step()
    optimiser.zero_grad(set_to_none=True)

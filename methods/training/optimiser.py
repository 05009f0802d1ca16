"""Steps of an optimiser at a given learning rate."""

from __future__ import annotations

import math

import torch


def cosine(done: float, final: float) -> float:
    """Share of the learning rate after a share `done` of the steps: monotone, 1 to `final`."""
    return final + (1 - final) * 0.5 * (1 + math.cos(math.pi * done))


def step_at(optimiser: torch.optim.Optimizer, rate: float) -> None:
    """A step at learning rate `rate`; the gradients are used up."""
    for group in optimiser.param_groups:
        group["lr"] = rate
    optimiser.step()
    optimiser.zero_grad(set_to_none=True)

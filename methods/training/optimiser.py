"""Optimiser steps at a given learning rate, and the schedule of that rate."""

from __future__ import annotations

import math

import torch


def cosine(done: float, final: float, half_waves: int = 1) -> float:
    """Share of the learning rate left after a share `done` of the steps: from 1 to `final`.

    One half wave falls all the way; three fall, rise to 1 again, and fall.
    """
    return final + (1 - final) * 0.5 * (1 + math.cos(half_waves * math.pi * done))


def step_at(optimiser: torch.optim.Optimizer, rate: float) -> None:
    """Take a step at learning rate `rate` and clear the gradients."""
    for group in optimiser.param_groups:
        group["lr"] = rate
    optimiser.step()
    optimiser.zero_grad(set_to_none=True)

"""Cases of the depthwise convolution of cells.

Numbers have few digits, so that nothing is rounded, whatever the order in which a sum is taken.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import torch
from torch import Tensor

from bench.case import Bound, Case, Given, Operation
from methods.kernels.dispatch import served
from methods.steernerf_lean.kernels.depthwise import TAPS, depthwise, neighbours_of

STEPS = 16
"""Numbers are multiples of 1/16 from -1 to 1, products multiples of 1/256; a sum of up to 2^15
products then has at most 23 bits."""

EXACT = Bound("short numbers: 0", 0.0)

FRAME = "a quarter of 200 x 200, 64 channels"  # of the lean renderer


def _draw(generator: torch.Generator, shape: Sequence[int]) -> Tensor:
    return torch.randint(-STEPS, STEPS + 1, tuple(shape), generator=generator) / STEPS


def _convolved(given: Given, backend: str) -> tuple[Tensor, ...]:
    return (depthwise(given["x"], given["neighbours"], given["weight"], backend=backend),)


GRADIENTS = {"x": EXACT, "weight": EXACT}
DEPTHWISE = Operation(
    "depthwise", served(__package__), _convolved, {"sums": EXACT}, GRADIENTS, _draw
)


def cases() -> list[Case]:
    """No, one and all cells; lines; scattered cells; several pictures; a frame, timed."""
    away = (torch.arange(200) + 0.5) / 200 - 0.5
    scattered = _scattered(1, 30, 20)
    kinds = {
        "no cell": (torch.zeros(1, 4, 5) > 0, 8),
        "one pixel": (torch.ones(1, 1, 1) > 0, 8),
        "one row": (torch.ones(1, 1, 40) > 0, 8),
        "all cells": (torch.ones(1, 9, 7) > 0, 8),
        "three pictures": (_scattered(3, 11, 6), 8),
        "one channel": (scattered, 1),
        "thirteen channels": (scattered, 13),
        FRAME: ((away[:, None] ** 2 + away**2 < 0.25 / torch.pi)[None], 64),
    }
    found = []
    for name, (cells, channels) in kinds.items():
        items = int(cells.sum()) if name == FRAME else None
        found += DEPTHWISE.cases(name, partial(_given, cells, channels), items=items)
    return found


def _scattered(*shape: int) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(shape[1])) < 0.5


def _given(cells: Tensor, channels: int) -> Given:
    generator, neighbours = torch.Generator().manual_seed(channels), neighbours_of(cells)
    x, weight = (_draw(generator, (rows, channels)) for rows in (len(neighbours), TAPS))
    return {"x": x, "neighbours": neighbours, "weight": weight}

"""Cases of the depthwise convolution of cells.

Forward inputs are arbitrary. Backward inputs have few digits, so that nothing is rounded, whatever
the order in which the gradient of the weights is summed.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from bench.case import U32, Agreement, Case
from methods.kernels.dispatch import served
from methods.steernerf_lean.kernels.depthwise import TAPS, depthwise, neighbours_of

LOW = 200
"""Side of the frame that is timed, in cells."""

SHARE = 0.25
"""Share of the frame's cells that contain something."""

WIDTH = 64
"""Channels of the trunk of the lean renderer."""

STEPS = 16
"""Backward inputs are multiples of 1/16 from -1 to 1, products multiples of 1/256; a sum of up to
2^15 products then has at most 23 bits."""


def cases() -> list[Case]:
    """No, one and all cells; lines; scattered cells; several pictures; a frame, timed."""
    frame = f"a quarter of {LOW} x {LOW}, {WIDTH} channels"
    kinds: list[tuple[str, Tensor, int]] = [
        ("no cell", torch.zeros(1, 4, 5, dtype=torch.bool), 8),
        ("one pixel", torch.ones(1, 1, 1, dtype=torch.bool), 8),
        ("one row", torch.ones(1, 1, 40, dtype=torch.bool), 8),
        ("one column", torch.ones(1, 40, 1, dtype=torch.bool), 8),
        ("all cells", torch.ones(1, 9, 7, dtype=torch.bool), 8),
        ("scattered", _scattered(1, 30, 20), 8),
        ("three pictures", _scattered(3, 11, 6), 8),
        ("one channel", _scattered(1, 30, 20), 1),
        ("thirteen channels", _scattered(1, 30, 20), 13),
        (frame, _disc(LOW), WIDTH),
    ]
    forward = Agreement(
        "depthwise",
        served(__package__),
        "nine products of at most 1, each rounded once and in at most 8 sums, twice: 162 u",
    )
    exact = Agreement("depthwise backward", served(__package__), "short numbers: 0")
    found = []
    for name, cells, channels in kinds:
        items = int(cells.sum()) if name == frame else None
        make = partial(_forward, cells, channels)
        found += [
            forward.case(name, make, 2 * TAPS * TAPS * U32, items=items),
            exact.case(name, partial(_backward, cells, channels), 0.0, items=items),
        ]
    return found


def _scattered(batch: int, height: int, width: int) -> Tensor:
    generator = torch.Generator().manual_seed(height)
    return torch.rand(batch, height, width, generator=generator) < 0.5


def _disc(side: int) -> Tensor:
    """A disc in the middle of a picture."""
    away = (torch.arange(side) + 0.5) / side - 0.5
    return (away[:, None] ** 2 + away**2 < SHARE / torch.pi)[None]


def _forward(cells: Tensor, channels: int, device: str) -> Callable[[str], tuple[Tensor, ...]]:
    generator = torch.Generator().manual_seed(channels)
    neighbours = neighbours_of(cells.to(device))
    x = 2 * torch.rand(len(neighbours), channels, generator=generator) - 1
    weight = 2 * torch.rand(TAPS, channels, generator=generator) - 1
    x, weight = x.to(device), weight.to(device)

    return lambda backend: (depthwise(x, neighbours, weight, backend=backend),)


def _backward(cells: Tensor, channels: int, device: str) -> Callable[[str], tuple[Tensor, ...]]:
    generator = torch.Generator().manual_seed(channels)
    neighbours = neighbours_of(cells.to(device))

    def draw(rows: int) -> Tensor:
        whole = torch.randint(-STEPS, STEPS + 1, (rows, channels), generator=generator)
        return (whole / STEPS).to(device)

    x, grad = draw(len(neighbours)).requires_grad_(), draw(len(neighbours))
    weight = draw(TAPS).requires_grad_()

    def call(backend: str) -> tuple[Tensor, ...]:
        out = depthwise(x, neighbours, weight, backend=backend)
        return torch.autograd.grad(out, (x, weight), grad)

    return call

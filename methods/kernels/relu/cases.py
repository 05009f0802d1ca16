"""Cases of the ReLU: all bfloat16 numbers, float32, forward and backward."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from bench.case import DTYPES, Agreement, Case
from methods.kernels.dispatch import served
from methods.kernels.relu import relu_

MANY = 1 << 17, 64
"""Samples and channels of the case that is timed."""


def cases() -> list[Case]:
    """Every bfloat16, none at all, rows that do not lie one after the other; a batch, timed."""
    forward = Agreement("relu", served(__package__), "a comparison: 0")
    backward = Agreement("relu backward", served(__package__), "a comparison: 0")
    bits = torch.arange(-(1 << 15), 1 << 15, dtype=torch.int32).to(torch.int16)
    every = bits.view(torch.bfloat16)
    kinds: list[tuple[str, str, Tensor]] = [
        ("every number", "bf16", every),
        ("every number, as float32", "fp32", every.float()),
        ("no number", "bf16", every[:0]),
        ("columns", "bf16", every.view(256, 256).T),
        ("{:,} x {}".format(*MANY), "bf16", _normal(*MANY)),
    ]
    found = []
    for name, precision, x in kinds:
        items = MANY[0] if x.shape == MANY else None
        found.append(
            forward.case(name, partial(_forward, x), 0.0, precision=precision, items=items)
        )
        numbers = torch.where(x.isnan(), 1, x)  # whether the gradient of a NaN passes is left open
        found.append(
            backward.case(name, partial(_backward, numbers), 0.0, precision=precision, items=items)
        )
    return found


def _normal(rows: int, channels: int) -> Tensor:
    generator = torch.Generator().manual_seed(0)
    return torch.randn(rows, channels, generator=generator).to(DTYPES["bf16"])


def _forward(x: Tensor, device: str) -> Callable[[str], tuple[Tensor, ...]]:
    x = x.to(device)
    buffer = torch.empty_like(x)  # preserves the strides

    def call(backend: str) -> tuple[Tensor, ...]:
        return (relu_(buffer.copy_(x), backend=backend),)

    return call


def _backward(x: Tensor, device: str) -> Callable[[str], tuple[Tensor, ...]]:
    given = x.to(device).requires_grad_()
    grad = torch.arange(x.numel(), device=device).view(x.shape).to(x.dtype)

    def call(backend: str) -> tuple[Tensor, ...]:
        return torch.autograd.grad(relu_(given.clone(), backend=backend), given, grad)

    return call

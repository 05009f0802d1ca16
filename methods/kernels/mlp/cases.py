"""Cases of the small network: one and two inputs, forward and backward, whole and odd widths.

Inputs, weights and gradients are small multiples of 1/8. Every sum then has at most 24 bits, so
that it is exact in any order, and no activation lies within rounding of the corner of a ReLU.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial

import torch
from torch import Tensor

from bench.case import DTYPES, Agreement, Case
from methods.kernels.dispatch import served
from methods.kernels.mlp import mlp

DENSITY, FEATURES = ((32,), (64, 16)), ((16, 16), (64, 64, 3))
"""Channels of the inputs, outputs of each layer: the networks of Instant-NGP."""

MANY = 1 << 17


def cases() -> list[Case]:
    """No sample, one, more than go together; a sample of NaN; many, timed; bfloat16."""
    forward = Agreement("mlp", served(__package__), "sums of few bits: 0")
    backward = Agreement("mlp backward", served(__package__), "sums of few bits: 0")
    found = []
    for count, (inputs, widths), dtype in (
        (0, DENSITY, "fp32"),
        (1, FEATURES, "fp32"),
        (97, ((7, 4), (20, 5)), "fp32"),
        (1000, ((3,), (5,)), "fp32"),
        (1000, DENSITY, "fp32"),
        (1000, FEATURES, "fp32"),
        (97, FEATURES, "bf16"),
        (MANY, DENSITY, "fp32"),
        (MANY, FEATURES, "fp32"),
    ):
        name = f"{count:,} of {' and '.join(map(str, inputs))}, {', '.join(map(str, widths))}"
        name += ", bf16" if dtype == "bf16" else ""
        items = count if count == MANY else None
        for kind, prepare in ((forward, _forward), (backward, _backward)):
            found.append(
                kind.case(
                    name,
                    partial(prepare, count, inputs, widths, dtype),
                    0.0,
                    precision=dtype,
                    items=items,
                )
            )
    return [*found, forward.case("a sample of NaN", _with_nan, 0.0)]


def _eighths(seed: int, most: int, *shape: int) -> Tensor:
    """Random multiples of 1/8, of at most `most`/8."""
    generator = torch.Generator().manual_seed(seed)
    return torch.randint(-most, most + 1, shape, generator=generator) / 8


def _network(
    count: int, inputs: Sequence[int], widths: Sequence[int], dtype: str, device: str
) -> tuple[list[Tensor], list[Tensor]]:
    given = [_eighths(seed, 8, count, channels) for seed, channels in enumerate(inputs)]
    channels = (sum(inputs), *widths)
    layers = [_eighths(9 + n, 1, channels[n + 1], channels[n]) for n in range(len(widths))]
    return _placed(given, dtype, device), _placed(layers, dtype, device)


def _placed(tensors: list[Tensor], dtype: str, device: str) -> list[Tensor]:
    return [tensor.to(device, DTYPES[dtype]) for tensor in tensors]


def _forward(
    count: int, inputs: Sequence[int], widths: Sequence[int], dtype: str, device: str
) -> Callable[[str], tuple[Tensor, ...]]:
    given, layers = _network(count, inputs, widths, dtype, device)
    return lambda backend: (mlp(given, layers, backend=backend),)


def _backward(
    count: int, inputs: Sequence[int], widths: Sequence[int], dtype: str, device: str
) -> Callable[[str], tuple[Tensor, ...]]:
    given, layers = _network(count, inputs, widths, dtype, device)
    learned = [x.requires_grad_() for x in (*given, *layers)]
    grad = _eighths(19, 8, count, widths[-1]).to(device, DTYPES[dtype])

    def call(backend: str) -> tuple[Tensor, ...]:
        return torch.autograd.grad(mlp(given, layers, backend=backend), learned, grad)

    return call


def _with_nan(device: str) -> Callable[[str], tuple[Tensor, ...]]:
    given, layers = _network(97, *FEATURES, "fp32", device)
    given[1][50, 3] = math.nan
    return lambda backend: (mlp(given, layers, backend=backend),)

"""Cases of the sparse Adam step: agreement of the backends, the first step in closed form.

The gradients of samples are short numbers, and so are their positions in cells, so that the sums of
a hash table's gradient are exact in any order.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from bench.case import U16, U32, Agreement, Case, Property
from methods.kernels.adam import AdamState, hash_adam_, sparse_adam_
from methods.kernels.dispatch import served
from methods.kernels.encode import HashGrid, SampleGradients, pack

STEPS = 3
RATE = 1e-2
LARGE = 1 << 20

DYADIC = {"levels": 2, "log2_table": 8, "n_min": 5, "n_max": 9}
"""A dense and a hashed level of 4 and 8 cells along an axis."""


def cases() -> list[Case]:
    """Tables in which none, some or all entries have a gradient; tiny and huge gradients."""
    kernel = Agreement(
        "adam",
        served(__package__),
        "moments of gradients below 6 are sums of products below 36; the table, at most 1 + 3 "
        "rates, is off by a few roundings a step, its bfloat16 copy by an ulp above 1",
    )
    tolerance = STEPS * 4 * 36 * U32 + 2 * U16
    kinds = ((0, 0.5), (1, 1.0), (5000, 0.0), (5000, 0.3), (5000, 1.0), (LARGE, 0.3))
    first = Property(
        "adam",
        "the step is that of the closed form",
        "moments, corrections, root, quotient and sum: 16 u of rates of 1",
        {(backend, "fp32"): 16 * U32 for backend in served(__package__)},
    )
    found = [
        first.case(f"first gradient {gradient:g}", partial(_first_step_error, gradient))
        for gradient in (0.0, 1e-40, 1e-30, 1e-15, 1.0, 1e15)
    ]
    for count, share in kinds:
        name, items = f"{share:.0%} of {count:,}", count if count == LARGE else None
        found.append(kernel.case(name, partial(_prepare, count, share, 2), tolerance, items=items))
    for features in (1, 3, 48):
        make = partial(_prepare, 70, 0.3, features)
        found.append(kernel.case(f"30% of 70, {features} features", make, tolerance))
    for samples, features in ((0, 2), (1, 2), (60, 2), (60, 1), (60, 3)):
        name = f"hash table, {samples} samples, {features} features"
        found.append(kernel.case(name, partial(_prepare_hash, samples, features), tolerance))
    return found


def _prepare(
    count: int, share: float, features: int, device: str
) -> Callable[[str], tuple[Tensor, ...]]:
    """With two features, the packed copy is checked, too."""
    generator = torch.Generator().manual_seed(count)
    table = torch.rand(count, features, generator=generator) * 2 - 1
    grads = [
        torch.randn(count, features, generator=generator)
        * (torch.rand(count, 1, generator=generator) < share)
        for _ in range(STEPS)
    ]
    table, grads = table.to(device), [grad.to(device) for grad in grads]

    def call(backend: str) -> tuple[Tensor, ...]:
        trained, state = table.clone(), AdamState.like(table)
        packed = pack(trained) if features == 2 else None
        for grad in grads:
            sparse_adam_(trained, grad.clone(), state, RATE, packed=packed, backend=backend)
        changed = trained, state.first, state.second, state.steps
        return changed if packed is None else (*changed, packed[:, None].view(torch.bfloat16))

    return call


def _prepare_hash(samples: int, features: int, device: str) -> Callable[[str], tuple[Tensor, ...]]:
    """The gradient of an entry is at most 3, the sum over its samples of weight and gradient."""
    grid = HashGrid(**DYADIC, features=features)
    generator = torch.Generator().manual_seed(samples)
    table = (torch.rand(grid.entries, features, generator=generator) * 2 - 1).to(device)
    steps = []
    for _ in range(STEPS):
        positions = torch.randint(33, (samples, 3), generator=generator) / 32
        grads = torch.randint(-2, 3, (samples, grid.channels), generator=generator) / 4
        steps.append((positions.to(device), grads.to(device)))

    def call(backend: str) -> tuple[Tensor, ...]:
        trained, state = table.clone(), AdamState.like(table)
        packed = pack(trained) if features == 2 else None
        for positions, grads in steps:
            gradients = SampleGradients()
            for part in zip(positions.split(40), grads.split(40), strict=True):
                gradients.add(*part)
            hash_adam_(trained, gradients, grid, state, RATE, packed=packed, backend=backend)
        changed = trained, state.first, state.second, state.steps
        return changed if packed is None else (*changed, packed[:, None].view(torch.bfloat16))

    return call


def _first_step_error(gradient: float, backend: str, device: str, precision: str) -> float:
    table = torch.zeros(3, 2, device=device)
    grad = torch.full_like(table, gradient)
    exact = grad[0, 0].item()  # rounded to float32
    sparse_adam_(table, grad, AdamState.like(table), 1.0, backend=backend)
    want = -exact / (abs(exact) + 1e-15)
    error = (table.double() - want).abs().max().item()
    return math.inf if math.isnan(error) else error

"""Cases of the sparse Adam step: agreement of the backends, the first step in closed form."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from bench.case import U16, U32, Agreement, Case, Property
from methods.kernels.adam import AdamState, sparse_adam_
from methods.kernels.dispatch import served
from methods.kernels.encode import pack

STEPS = 3
RATE = 1e-2
LARGE = 1 << 20


def cases() -> list[Case]:
    """Tables in which none, some or all entries have a gradient; tiny and huge gradients."""
    kernel = Agreement(
        "adam",
        served("adam"),
        "moments of gradients below 6 are sums of products below 36; the table, at most 1 + 3 "
        "rates, is off by a few roundings a step, its bfloat16 copy by an ulp above 1",
    )
    tolerance = STEPS * 4 * 36 * U32 + 2 * U16
    kinds = ((0, 0.5), (1, 1.0), (5000, 0.0), (5000, 0.3), (5000, 1.0), (LARGE, 0.3))
    first = Property(
        "adam",
        "the step is that of the closed form",
        "moments, corrections, root, quotient and sum: 16 u of rates of 1",
        {(backend, "fp32"): 16 * U32 for backend in served("adam")},
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


def _first_step_error(gradient: float, backend: str, device: str, precision: str) -> float:
    table = torch.zeros(3, 2, device=device)
    grad = torch.full_like(table, gradient)
    exact = grad[0, 0].item()  # rounded to float32
    sparse_adam_(table, grad, AdamState.like(table), 1.0, backend=backend)
    want = -exact / (abs(exact) + 1e-15)
    error = (table.double() - want).abs().max().item()
    return math.inf if math.isnan(error) else error

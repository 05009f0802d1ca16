"""Cases of the sparse Adam step."""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor

from methods.kernels.adam import AdamState, sparse_adam_
from methods.kernels.case import U16, U32, Case, Prepared
from methods.kernels.encode import pack

STEPS = 3
RATE = 1e-2


def cases() -> list[Case]:
    """Tables none, some and all of whose entries got a gradient."""
    kinds = ((0, 0.5), (1, 1.0), (5000, 0.0), (5000, 0.3), (5000, 1.0))
    return [
        Case("adam", f"{share:.0%} of {count:,}", "fp32", count, partial(_prepare, count, share))
        for count, share in kinds
    ] + [Case("adam", "30% of 1,048,576", "fp32", 1 << 20, partial(_prepare, 1 << 20, 0.3), True)]


def _prepare(count: int, share: float, device: str) -> Prepared:
    generator = torch.Generator().manual_seed(count)
    table = torch.rand(count, 2, generator=generator) * 2 - 1
    grads = [
        torch.randn(count, 2, generator=generator)
        * (torch.rand(count, 1, generator=generator) < share)
        for _ in range(STEPS)
    ]
    table, grads = table.to(device), [grad.to(device) for grad in grads]

    def call(backend: str) -> tuple[Tensor, ...]:
        trained, state = table.clone(), AdamState.like(table)
        packed = pack(trained)
        for grad in grads:
            sparse_adam_(trained, grad.clone(), state, RATE, packed=packed, backend=backend)
        unpacked = packed[:, None].view(torch.bfloat16).float()
        return trained, state.first, state.second, state.steps, unpacked

    # Moments of gradients below 6 are sums of products below 36; the table, at most 1 + 3 RATE, is
    # off by a few roundings a step, and its bfloat16 copy by an ulp above 1.
    return Prepared(call, STEPS * 4 * 36 * U32 + 2 * U16)

"""Sparse Adam with Triton: one pass, each program handles a block of entries.

It reads the gradient of every entry, 4 F bytes. For entries with a non-zero gradient it also reads
and writes the table, both moments and the step count, 12 F + 4 bytes each way, and writes a
gradient of 0 and the packed copy, 4 F + 4 bytes.
"""

from functools import cache

import torch
import triton
import triton.language as tl
from torch import Tensor

from methods.kernels import adam
from methods.kernels.adam import AdamState, corrections
from methods.kernels.encode import HashGrid
from methods.kernels.encode.gpu import table_gradient
from methods.kernels.gpu import check_float32, launch

BLOCK = tl.constexpr(1024)
"""Features per program, 8 per lane: that many concurrent loads hide their latency."""

BETA1, BETA2 = tl.constexpr(adam.BETAS[0]), tl.constexpr(adam.BETAS[1])
EPS = tl.constexpr(adam.EPS)


@torch.no_grad()
def sparse_adam_(table: Tensor, grad: Tensor, state: AdamState, rate: float) -> None:
    _step(table, grad, state, rate, None)


def _step(
    table: Tensor, grad: Tensor, state: AdamState, rate: float, packed: Tensor | None
) -> None:
    given = {"table": table, "grad": grad, "first": state.first, "second": state.second}
    check_float32(**given)
    for name, tensor in given.items():
        if not tensor.is_contiguous():
            raise ValueError(f"backend 'gpu' expects {name} to be contiguous")
    (entries, features), known = table.shape, _corrections(table.device)
    words = None if packed is None else packed.view(torch.bfloat16)
    numbers = *given.values(), state.steps, words, known, known.shape[1] - 1, rate, entries
    programs = triton.cdiv(entries, BLOCK.value // triton.next_power_of_2(features))
    launch(_update, (programs,), *numbers, FEATURES=features)


@torch.no_grad()
def hash_adam_(
    table: Tensor,
    positions: Tensor,
    grad: Tensor,
    grid: HashGrid,
    state: AdamState,
    rate: float,
    packed: Tensor | None,
) -> None:
    if state.gradient is None:
        state.gradient = torch.zeros_like(table)
    _step(table, table_gradient(positions, grad, grid, state.gradient), state, rate, packed)


@cache
def _corrections(device: torch.device) -> Tensor:
    """Cached per device, because each copy to the device would synchronise."""
    return corrections().to(device)


@triton.jit
def _update(
    table, grad, first, second, steps, packed, known, last, rate, entries, FEATURES: tl.constexpr
):
    """`last` is the largest number of steps in `known`, the corrections; `packed` is of bfloat16.
    `FEATURES` is known at compile time, so that a lane can load two or four at once."""
    WIDTH: tl.constexpr = triton.next_power_of_2(FEATURES)
    ROWS: tl.constexpr = BLOCK // WIDTH
    entry = tl.program_id(0).to(tl.int64) * ROWS + tl.arange(0, ROWS)
    feature = tl.arange(0, WIDTH)
    inside = (entry < entries)[:, None] & (feature < FEATURES)[None, :]
    place = entry[:, None] * FEATURES + feature[None, :]
    gradient = tl.load(grad + place, mask=inside, other=0.0)
    touched = tl.max((gradient != 0).to(tl.int32), 1) > 0
    step = tl.load(steps + entry, mask=touched, other=0) + 1
    known += tl.minimum(step, last)
    correction1, correction2 = tl.load(known)[:, None], tl.load(known + last + 1)[:, None]
    changed = inside & touched[:, None]
    m = tl.load(first + place, mask=changed, other=0.0) * BETA1 + gradient * (1 - BETA1)
    squared = gradient * (1 - BETA2) * gradient
    v = tl.load(second + place, mask=changed, other=0.0) * BETA2 + squared
    scale = tl.sqrt_rn(v * correction2) + EPS
    old = tl.load(table + place, mask=changed, other=0.0)
    new = old - tl.div_rn(rate * m * correction1, scale)
    tl.debug_barrier()  # all warps must have read `steps` before any writes
    tl.store(steps + entry, step, mask=touched)
    tl.store(first + place, m, mask=changed)
    tl.store(second + place, v, mask=changed)
    tl.store(table + place, new, mask=changed)
    tl.store(grad + place, tl.zeros_like(gradient), mask=changed)
    if packed is not None:
        tl.store(packed + place, new.to(tl.bfloat16), mask=changed)

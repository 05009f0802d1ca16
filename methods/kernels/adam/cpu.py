"""Sparse Adam with numba: one pass over the gradient, one over the entries that have one."""

from __future__ import annotations

import math

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from methods.kernels.adam import BETAS, EPS, AdamState, corrections
from methods.kernels.cpu import f32, pack_bf16, u64

CHUNK = 4096  # entries that are searched for gradients before any of them is updated

BETA1, BETA2, EPSILON = f32(BETAS[0]), f32(BETAS[1]), f32(EPS)
ONE = u64(1)


@torch.no_grad()
def sparse_adam_(
    table: Tensor, grad: Tensor, state: AdamState, rate: float, packed: Tensor | None
) -> None:
    """See `methods.kernels.adam.sparse_adam_`."""
    if table.dtype != torch.float32:
        raise ValueError(f"backend 'cpu' updates float32, got {table.dtype}")
    words = np.empty(0, np.uint32) if packed is None else packed.numpy().view(np.uint32)
    _update(
        *(x.view(-1).numpy() for x in (table, grad, state.first, state.second)),
        state.steps.numpy(),
        words,
        *corrections().numpy(),
        f32(rate),
    )


@njit(cache=True, parallel=True, error_model="numpy")
def _update(table, grad, first, second, steps, packed, to1, to2, rate):
    """`table`, `grad`, `first` and `second` are flat; `to1` and `to2` are the corrections."""
    entries = len(steps)
    features = len(table) // max(entries, 1)
    for chunk in prange((entries + CHUNK - 1) // CHUNK):
        a, b = chunk * CHUNK, min(entries, (chunk + 1) * CHUNK)
        if features == 2:  # so that the compiler knows it
            _entries(a, b, 2, table, grad, first, second, steps, packed, to1, to2, rate)
        else:
            _entries(a, b, features, table, grad, first, second, steps, packed, to1, to2, rate)


@njit(inline="always")
def _entries(a, b, features, table, grad, first, second, steps, packed, to1, to2, rate):
    touched = np.empty(CHUNK, np.uint32)
    count = _find(a, b, features, grad, touched)
    _step(touched, count, features, table, grad, first, second, steps, packed, to1, to2, rate)


@njit(inline="always")
def _find(a, b, features, grad, touched):
    """List the entries from `a` to `b` that have a gradient; return their number. There is no
    branch, which a CPU would mispredict at almost every other entry."""
    count = u64(0)
    for entry in range(a, b):
        found = False
        for feature in range(features):
            found |= grad[u64(entry * features) + u64(feature)] != 0
        touched[count] = entry
        count += u64(found)
    return count


@njit(inline="always")
def _step(touched, count, features, table, grad, first, second, steps, packed, to1, to2, rate):
    """Update the first `count` entries of `touched`."""
    last = len(to1) - 1
    for k in range(count):
        entry = u64(touched[k])
        begin = entry * u64(features)
        steps[entry] += 1
        step = u64(min(steps[entry], last))
        for feature in range(features):
            i = begin + u64(feature)
            gradient = grad[i]
            grad[i] = f32(0)
            m = BETA1 * first[i] + (f32(1) - BETA1) * gradient
            v = BETA2 * second[i] + (f32(1) - BETA2) * gradient * gradient
            first[i], second[i] = m, v
            table[i] -= rate * m * to1[step] / (math.sqrt(v * to2[step]) + EPSILON)
        if len(packed):
            packed[entry] = pack_bf16(table[begin], table[begin + ONE])

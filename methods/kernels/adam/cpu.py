"""Sparse Adam with numba: one pass over the gradient, one over the entries that have one.

For a hash table, a thread takes a level, adds up its gradient, which stays in the cache (1 MB for
T = 2^17), and updates it, before it takes the next one. So at most as many threads as levels work.
"""

import math
from typing import Any

import numpy as np
import torch
from numba import get_num_threads, prange
from torch import Tensor

from methods.kernels.adam import BETAS, EPS, AdamState, corrections
from methods.kernels.cpu import check_float32, f32, jit, pack_bf16, u64
from methods.kernels.encode import HashGrid
from methods.kernels.encode.cpu import by_channel, level_arrays, scatter_level

CHUNK = 4096  # entries that are searched for gradients before any of them is updated

BETA1, BETA2, EPSILON = f32(BETAS[0]), f32(BETAS[1]), f32(EPS)
ONE = u64(1)


@torch.no_grad()
def sparse_adam_(table: Tensor, grad: Tensor, state: AdamState, rate: float) -> None:
    _update(grad.view(-1).numpy(), table.shape[1], *_arrays(table, state, rate, None))


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
    samples = positions.numpy(), by_channel(grad).numpy()
    workers = min(get_num_threads(), grid.levels)
    _update_levels(*samples, level_arrays(grid), *_arrays(table, state, rate, packed), workers)


def _arrays(
    table: Tensor, state: AdamState, rate: float, packed: Tensor | None
) -> tuple[tuple[np.ndarray, ...], tuple[Any, ...]]:
    """`own` and `how` of `_entries`."""
    check_float32(table)
    words = np.empty(0, np.uint32) if packed is None else packed.numpy().view(np.uint32)
    tables = (x.view(-1).numpy() for x in (table, state.first, state.second))
    return (*tables, state.steps.numpy(), words), (*corrections().numpy(), f32(rate))


@jit(parallel=True, error_model="numpy")
def _update(grad, features, own, how):
    entries = len(own[3])
    for chunk in prange((entries + CHUNK - 1) // CHUNK):
        _entries(chunk * CHUNK, min(entries, (chunk + 1) * CHUNK), features, grad, own, how)


@jit(parallel=True, error_model="numpy")
def _update_levels(positions, grad, shapes, tables, how, workers):
    """As `_update`, with the gradient `grad` [levels * features, N] of samples at `positions`."""
    scales, strides, offsets = shapes
    table, first, second, steps, packed = tables
    levels = len(scales)
    features = len(grad) // levels
    largest = np.max(offsets[1:] - offsets[:-1])
    for worker in prange(workers):
        total = np.zeros(largest * features, np.float32)
        # Every workers-th level, because fine levels cost the most.
        for level in range(worker, levels, workers):
            scatter_level(level, positions, grad, scales, strides, offsets, total)
            begin, end = offsets[level], offsets[level + 1]
            a, b = begin * features, end * features
            words = packed[begin:end] if len(packed) else packed
            own = table[a:b], first[a:b], second[a:b], steps[begin:end], words
            for entry in range(0, end - begin, CHUNK):
                last = min(end - begin, entry + CHUNK)
                _entries(entry, last, features, total, own, how)


@jit(error_model="numpy")
def _entries(a, b, features, grad, own, how):
    """Update the entries from `a` to `b`, at most `CHUNK`, and clear their gradient. All arrays are
    flat: `grad`; `own`, which are table, moments, steps and packed copy, the latter empty if there
    is none. `how` are the bias corrections and the rate."""
    table, first, second, steps, packed = own
    to1, to2, rate = how
    touched = np.empty(CHUNK, np.uint32)
    if features == 2:  # so that the compiler knows it
        count = _find(a, b, 2, grad, touched)
        _step(touched, count, 2, grad, table, first, second, steps, packed, to1, to2, rate)
    else:
        count = _find(a, b, features, grad, touched)
        _step(touched, count, features, grad, table, first, second, steps, packed, to1, to2, rate)


@jit(inline="always")
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


@jit(inline="always")
def _step(touched, count, features, grad, table, first, second, steps, packed, to1, to2, rate):
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

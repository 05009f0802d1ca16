"""Sparse Adam with numba: one pass over the gradient, one over what it touched."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from methods.kernels.adam import BETAS, EPS, AdamState
from methods.kernels.cpu import f32, pack_bf16

CHUNK = 4096  # entries


@torch.no_grad()
def sparse_adam_(
    table: Tensor, grad: Tensor, state: AdamState, rate: float, packed: Tensor | None
) -> None:
    """See `methods.kernels.adam.sparse_adam_`."""
    if table.dtype != torch.float32:
        raise ValueError(f"backend 'cpu' updates float32, got {table.dtype}")
    words = np.empty(0, np.uint32) if packed is None else packed.numpy().view(np.uint32)
    _update(
        table.numpy(),
        grad.numpy(),
        state.first.numpy(),
        state.second.numpy(),
        state.steps.numpy(),
        words,
        _corrections(BETAS[0]),
        _corrections(BETAS[1]),
        f32(rate),
        f32(BETAS[0]),
        f32(BETAS[1]),
        f32(EPS),
    )


@cache
def _corrections(beta: float) -> np.ndarray:
    """1 / (1 - beta^n) for n = 0, 1, ... until float32 cannot tell it from 1; n = 0 is not used."""
    last = math.ceil(math.log(2.0**-25) / math.log(beta))
    powers = np.power(beta, np.arange(1, last + 1))
    return np.concatenate(([np.inf], 1 / (1 - powers))).astype(np.float32)


@njit(cache=True, parallel=True)
def _update(
    table, grad, first, second, steps, packed, corrections1, corrections2, rate, beta1, beta2, eps
):
    entries, features = table.shape
    for chunk in prange((entries + CHUNK - 1) // CHUNK):
        for entry in range(chunk * CHUNK, min(entries, (chunk + 1) * CHUNK)):
            touched = False
            for feature in range(features):
                touched |= grad[entry, feature] != 0
            if not touched:
                continue
            steps[entry] += 1
            correction1 = corrections1[min(steps[entry], len(corrections1) - 1)]
            correction2 = corrections2[min(steps[entry], len(corrections2) - 1)]
            for feature in range(features):
                gradient = grad[entry, feature]
                grad[entry, feature] = f32(0)
                m = beta1 * first[entry, feature] + (f32(1) - beta1) * gradient
                v = beta2 * second[entry, feature] + (f32(1) - beta2) * gradient * gradient
                first[entry, feature], second[entry, feature] = m, v
                scale = math.sqrt(v * correction2) + eps
                table[entry, feature] -= rate * m * correction1 / scale
            if len(packed):
                packed[entry] = pack_bf16(table[entry, 0], table[entry, 1])

"""Sparse Adam with numba: one pass over the gradient, one over the entries that have one."""

from __future__ import annotations

import math

import numpy as np
import torch
from numba import njit, prange
from torch import Tensor

from methods.kernels.adam import BETAS, EPS, AdamState, corrections
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
        *corrections().numpy(),
        f32(rate),
        f32(BETAS[0]),
        f32(BETAS[1]),
        f32(EPS),
    )


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

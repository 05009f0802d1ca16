"""Sparse Adam in plain torch."""

from __future__ import annotations

import torch
from torch import Tensor

from methods.kernels.adam import BETAS, EPS, AdamState
from methods.kernels.encode import pack


@torch.no_grad()
def sparse_adam_(
    table: Tensor, grad: Tensor, state: AdamState, rate: float, packed: Tensor | None
) -> None:
    """See `methods.kernels.adam.sparse_adam_`."""
    touched = (grad != 0).any(dim=-1).nonzero().squeeze(-1)
    gradient = grad[touched]
    state.steps[touched] += 1
    steps = state.steps[touched, None].to(table.dtype)
    first = BETAS[0] * state.first[touched] + (1 - BETAS[0]) * gradient
    second = BETAS[1] * state.second[touched] + (1 - BETAS[1]) * gradient * gradient
    state.first[touched], state.second[touched] = first, second
    unbiased = first / (1 - BETAS[0] ** steps)
    scale = (second / (1 - BETAS[1] ** steps)).sqrt() + EPS
    table[touched] -= rate * unbiased / scale
    grad.zero_()
    if packed is not None:
        packed[touched] = pack(table[touched])

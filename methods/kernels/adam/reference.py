"""Sparse Adam in plain torch."""

import torch
from torch import Tensor

from methods.kernels.adam import BETAS, EPS, AdamState
from methods.kernels.encode import HashGrid, pack
from methods.kernels.encode.reference import encode


@torch.no_grad()
def sparse_adam_(table: Tensor, grad: Tensor, state: AdamState, rate: float) -> None:
    touched = (grad != 0).any(dim=-1, keepdim=True)  # a mask, as indices would wait for a GPU
    state.steps += touched.squeeze(-1)
    steps = state.steps[:, None].to(table.dtype)
    first = BETAS[0] * state.first + (1 - BETAS[0]) * grad
    second = BETAS[1] * state.second + (1 - BETAS[1]) * grad * grad
    unbiased = first / (1 - BETAS[0] ** steps)
    scale = (second / (1 - BETAS[1] ** steps)).sqrt() + EPS
    table.copy_(torch.where(touched, table - rate * unbiased / scale, table))
    state.first.copy_(torch.where(touched, first, state.first))
    state.second.copy_(torch.where(touched, second, state.second))
    grad.zero_()


def hash_adam_(
    table: Tensor,
    positions: Tensor,
    grad: Tensor,
    grid: HashGrid,
    state: AdamState,
    rate: float,
    packed: Tensor | None,
) -> None:
    asking = table.detach().requires_grad_()
    with torch.enable_grad():
        encoded = encode(positions, asking, grid, None)
    (total,) = torch.autograd.grad(encoded, asking, grad.to(table.dtype))
    sparse_adam_(table, total, state, rate)
    if packed is not None:
        packed.copy_(pack(table))

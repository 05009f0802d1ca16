"""Muon (Jordan et al. 2024, kellerjordan.github.io/posts/muon) for the weights of convolutions."""

import math
from collections.abc import Iterable

import torch
from torch import Tensor

MOMENTUM = 0.9  # published: 0.95; chosen on held-out views after 500 steps

QUINTIC = 3.4445, -4.7750, 2.0315
"""Published coefficients of the iteration: its slope at 0 is large, its limit only about 1."""

ITERATIONS = 5


class Muon(torch.optim.Optimizer):
    """A convolution's weight is a matrix with a row for each output channel. A step subtracts the
    gradient's momentum (Nesterov's) with all singular values set to about 1, scaled to a root mean
    square of 0.2 times the learning rate `lr`.

    `torch.optim.Muon` iterates in bfloat16, which takes a processor without such products 20 times
    as long as float32.
    """

    def __init__(self, weights: Iterable[Tensor], lr: float) -> None:
        super().__init__(weights, {"lr": lr})

    @torch.no_grad()
    def step(self, closure: None = None) -> None:  # type: ignore[override]
        """Update the weights by their gradients."""
        for group in self.param_groups:
            for weight in group["params"]:
                if weight.grad is None:
                    continue
                state = self.state[weight]
                if not state:
                    state["momentum"] = torch.zeros_like(weight)
                momentum = state["momentum"].lerp_(weight.grad, 1 - MOMENTUM)
                matrix = weight.grad.lerp(momentum, MOMENTUM).flatten(1)
                rate = group["lr"] * 0.2 * math.sqrt(max(matrix.shape))
                weight.sub_(orthogonal(matrix).unflatten(1, weight.shape[1:]), alpha=rate)


def orthogonal(matrix: Tensor) -> Tensor:
    """About U V^T of `matrix` [M, N] = U S V^T: each of its singular values, all between 0.7 and
    1.2 unless they were tiny, by the Newton-Schulz iteration x <- a x + b (x x^T) x + c (x x^T)^2
    x."""
    a, b, c = QUINTIC
    wide = matrix if len(matrix) <= matrix.shape[1] else matrix.T
    x = wide / matrix.norm().clamp(min=1e-7)
    for _ in range(ITERATIONS):
        gram = x @ x.T
        x = torch.addmm(x, torch.addmm(gram, gram, gram, beta=b, alpha=c), x, beta=a)
    return x if wide is matrix else x.T

"""Muon (Jordan et al. 2024, kellerjordan.github.io/posts/muon) for the weights of convolutions."""

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor, nn

MOMENTUM = 0.9  # torch: 0.95; chosen on held-out views after 500 steps


class Muon(torch.optim.Muon):
    """torch's Muon takes matrices: here, a convolution is one with a row for each output channel.

    A step subtracts the gradient's momentum with all singular values set to about 1, scaled to a
    root mean square of 0.2 times the learning rate. The `weights` [out, in, height, width] must be
    in channels-last memory, which the matrices share; ValueError otherwise.
    """

    def __init__(self, weights: Iterable[Tensor], lr: float) -> None:
        self._weights = list(weights)
        for weight in self._weights:
            if not weight.is_contiguous(memory_format=torch.channels_last):
                raise ValueError(f"expected channels-last weights, got strides {weight.stride()}")
        matrices = [nn.Parameter(_matrix(weight.detach())) for weight in self._weights]
        given: Any = {"weight_decay": 0.0, "momentum": MOMENTUM, "adjust_lr_fn": "match_rms_adamw"}
        super().__init__(matrices, lr, **given)

    def step(self, closure: None = None) -> None:  # type: ignore[override]
        """Update the weights by their gradients."""
        for matrix, weight in zip(self.param_groups[0]["params"], self._weights, strict=True):
            matrix.grad = None if weight.grad is None else _matrix(weight.grad)
        super().step(closure)

    def zero_grad(self, set_to_none: bool = True) -> None:
        """Clear the gradients of the weights, too."""
        super().zero_grad(set_to_none)
        for weight in self._weights:
            weight.grad = None


def _matrix(x: Tensor) -> Tensor:
    """[out, in, height, width] as [out, height width in], without a copy if channels last."""
    return x.permute(0, 2, 3, 1).flatten(1)

"""A small network in plain torch, layer by layer."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor
from torch.nn import functional


def mlp(inputs: Sequence[Tensor], weights: Sequence[Tensor]) -> Tensor:
    return layer_by_layer(inputs, weights, Tensor.relu_)


def layer_by_layer(
    inputs: Sequence[Tensor], weights: Sequence[Tensor], relu_: Callable[[Tensor], Tensor]
) -> Tensor:
    """`mlp` with a ReLU of its own, which may work in place."""
    x = inputs[0] if len(inputs) == 1 else torch.cat(tuple(inputs), dim=1)
    for layer in weights[:-1]:
        x = relu_(functional.linear(x, layer))
    return functional.linear(x, weights[-1])

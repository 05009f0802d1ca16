"""A small network in plain torch, layer by layer."""

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn import functional

from bench.types import SomeTensors


def mlp(inputs: SomeTensors, weights: SomeTensors) -> Tensor:
    return layer_by_layer(inputs, weights, Tensor.relu_)


def layer_by_layer(
    inputs: SomeTensors, weights: SomeTensors, relu_: Callable[[Tensor], Tensor]
) -> Tensor:
    """`mlp` with a ReLU of its own, which may work in place."""
    x = inputs[0] if len(inputs) == 1 else torch.cat(tuple(inputs), dim=1)
    for layer in weights[:-1]:
        x = relu_(functional.linear(x, layer))
    return functional.linear(x, weights[-1])

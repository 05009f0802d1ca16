"""A small network in plain torch, layer by layer."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional


def mlp(inputs: Sequence[Tensor], weights: Sequence[Tensor]) -> Tensor:
    """See `methods.kernels.mlp.mlp`."""
    x = torch.cat(tuple(inputs), dim=1)
    for layer in weights[:-1]:
        x = functional.linear(x, layer).relu_()
    return functional.linear(x, weights[-1])

"""ReLU in place, between the layers of small networks on many samples."""

from __future__ import annotations

from torch import Tensor

from methods.kernels.dispatch import implementation


def relu_(x: Tensor, *, backend: str = "auto") -> Tensor:
    """Replace the negative numbers of `x`, of any shape, by 0, and return it; NaN stays.

    Differentiable: the gradient passes where the result is not 0.
    """
    rectified: Tensor = implementation(__name__, backend, x.device).relu_(x)
    return rectified

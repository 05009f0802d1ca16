"""Convolution and halving in plain torch, any dtype and device."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional

from methods.steernerf.kernels.spans import Spans


def convolution(
    parts: Sequence[Tensor],
    weight: Tensor,
    bias: Tensor,
    plus: Tensor | None,
    relu: bool,
    shuffle: bool,
    spans: Spans | None,
) -> Tensor:
    """The sum of the convolutions of all `parts`, which are not copied side by side."""
    if spans is not None:
        mask = spans.mask(*parts[0].shape[2:])
        parts = [torch.where(mask, part, 0) for part in parts]
    *weights, last = weight.split([part.shape[1] for part in parts], dim=1)
    out = functional.conv2d(parts[-1], last, bias, padding=1)
    for part, of_part in zip(parts, weights, strict=False):
        out = functional.conv2d(part, of_part, padding=1) + out
    if plus is not None:
        out = plus + out
    if shuffle:
        out = functional.pixel_shuffle(out, 2)
    return out.relu() if relu else out


def halved(pictures: Tensor, spans: Spans | None) -> Tensor:
    """Max pooling."""
    return functional.max_pool2d(pictures, 2)

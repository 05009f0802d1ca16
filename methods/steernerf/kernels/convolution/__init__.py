"""3 x 3 convolution of pictures, with what follows it in a U-Net, and halving by the maximum.

There is no Triton version: on a GPU torch computes both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from bench.types import check_shape
from methods.kernels.dispatch import implementation, torch_for_gpu


@dataclass(frozen=True)
class Spans:
    """The part of a picture that is computed: in each band of `unit` rows, the columns from the
    first to before the second of `columns` [bands, 2] int64, which are in units as well. A unit is
    a multiple of 4 pixels."""

    columns: Tensor
    unit: int

    def at(self, size: int) -> Spans:
        """The same of a picture that is 1 / `size` as wide and high."""
        return replace(self, unit=self.unit // size)

    def mask(self, height: int, width: int) -> Tensor:
        """Which pixels of a picture are computed, [height, width] bool."""
        first, end = self.columns.repeat_interleave(self.unit, 0)[:height].unbind(1)
        column = torch.arange(width, device=first.device) // self.unit
        return (column >= first[:, None]) & (column < end[:, None])

    def count(self, height: int, width: int) -> int:
        """How many pixels of a picture are computed."""
        first, end = (self.unit * self.columns).clamp(max=width).unbind(1)
        tops = self.unit * torch.arange(len(first), device=first.device)
        return int(((end - first).clamp(min=0) * (height - tops).clamp(0, self.unit)).sum())


def convolution(
    parts: Sequence[Tensor],
    weight: Tensor,
    bias: Tensor,
    *,
    plus: Tensor | None = None,
    relu: bool = False,
    shuffle: bool = False,
    spans: Spans | None = None,
    backend: str = "auto",
) -> Tensor:
    """Convolve the channels of one or two `parts` [B, C, H, W], which are 0 beyond their border,
    with `weight` [O, all C, 3, 3], and add `bias` [O] and perhaps `plus` [B, O, H, W].

    Returns [B, O, H, W], without negative numbers if `relu`; if `shuffle`, which goes without
    `plus`, every four channels become one of twice the height and width, as by `pixel_shuffle`.
    Outside the `spans` of the parts, the result is 0. Differentiable in all tensors.
    """
    first = parts[0]
    check_shape("weight", weight, None, sum(part.shape[1] for part in parts), 3, 3)
    check_shape("bias", bias, len(weight))
    for part in parts:
        check_shape("parts", part, len(first), None, *first.shape[2:])
    if plus is not None:
        check_shape("plus", plus, len(first), len(weight), *first.shape[2:])
    if spans is not None:
        bands = len(spans.columns)
        if spans.unit % 4 or bands * spans.unit < first.shape[2]:
            raise ValueError(
                f"spans: expected a unit of a multiple of 4 pixels, and bands of {first.shape[2]} "
                f"rows in all, got {bands} of {spans.unit}"
            )
    kernel = implementation(__name__, torch_for_gpu(backend), first.device)
    return kernel.convolution(parts, weight, bias, plus, relu, shuffle, spans)


def halved(pictures: Tensor, *, backend: str = "auto") -> Tensor:
    """The maximum of every 2 x 2 pixels of `pictures` [B, C, H, W], of even height and width.
    Differentiable."""
    check_shape("pictures", pictures, None, None, None, None)
    if any(side % 2 for side in pictures.shape[2:]):
        raise ValueError(f"pictures: expected even sides, got {tuple(pictures.shape[2:])}")
    return implementation(__name__, torch_for_gpu(backend), pictures.device).halved(pictures)

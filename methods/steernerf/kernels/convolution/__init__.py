"""3 x 3 convolution of pictures, with what follows it in a U-Net, and halving by the maximum.

There is no Triton version: on a GPU torch computes both.
"""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from bench.types import check_shape
from methods.kernels.dispatch import implementation, torch_for_gpu
from methods.steernerf.kernels.spans import Spans


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
    `spans` are those of the parts. Differentiable in all tensors.
    """
    first = parts[0]
    check_shape("weight", weight, None, sum(part.shape[1] for part in parts), 3, 3)
    check_shape("bias", bias, len(weight))
    for part in parts:
        check_shape("parts", part, len(first), None, *first.shape[2:])
    if plus is not None:
        check_shape("plus", plus, len(first), len(weight), *first.shape[2:])
    kernel = implementation(__name__, torch_for_gpu(backend), first.device)
    return kernel.convolution(parts, weight, bias, plus, relu, shuffle, spans)


def halved(pictures: Tensor, *, spans: Spans | None = None, backend: str = "auto") -> Tensor:
    """The maximum of every 2 x 2 pixels of `pictures` [B, C, H, W], of even height and width, with
    `spans`. Differentiable."""
    check_shape("pictures", pictures, None, None, None, None)
    if any(side % 2 for side in pictures.shape[2:]):
        raise ValueError(f"pictures: expected even sides, got {tuple(pictures.shape[2:])}")
    kernel = implementation(__name__, torch_for_gpu(backend), pictures.device)
    return kernel.halved(pictures, spans)

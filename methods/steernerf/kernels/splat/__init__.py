"""Splats points into pixels and gathers their features: the reprojection of earlier frames.

`splat` finds which point each pixel shows; `gather` fetches the features of these points. Pixel
(i, j) covers [i, i+1) x [j, j+1), so a point at (u, v) lands only in (floor u, floor v).
"""

from __future__ import annotations

import torch
from torch import Tensor

from bench.types import check_shape
from methods.kernels.dispatch import implementation


def splat(
    pixels: Tensor, depth: Tensor, width: int, height: int, *, backend: str = "auto"
) -> Tensor:
    """Find which of N points each pixel of a width x height picture shows: [height, width] int32.

    The points have continuous coordinates (u, v) `pixels` [N, 2] and a z-depth `depth` [N]. An
    entry is the index of the last point that lands there, whatever its depth, -1 for none: in
    SteerNeRF's release points overwrite each other. Only points inside the picture with a finite
    positive depth count. Not differentiable; for features use `gather`.
    """
    check_shape("pixels", pixels, None, 2)
    check_shape("depth", depth, len(pixels))
    chosen = implementation(__name__, backend, pixels.device)
    return chosen.splat(pixels.detach(), depth.detach(), width, height)


def gather(values: Tensor, index: Tensor, *, backend: str = "auto") -> Tensor:
    """Rows of `values` [N, C] at `index` [...] int32, as from `splat`, zeros where it is -1:
    [..., C]. Differentiable in `values`; the gradient of a row is the sum over all pixels that
    show it."""
    check_shape("values", values, None, None)
    chosen = implementation(__name__, backend, values.device)
    rows = _Gather.apply(values.contiguous(), index.contiguous().view(-1), chosen)
    return rows.view(*index.shape, values.shape[1])


class _Gather(torch.autograd.Function):
    @staticmethod
    def forward(ctx, values, index, chosen):
        ctx.save_for_backward(index)
        ctx.points, ctx.chosen = len(values), chosen
        return chosen.gather(values.detach(), index)

    @staticmethod
    def backward(ctx, grad):
        (index,) = ctx.saved_tensors
        return ctx.chosen.scatter(grad.contiguous(), index, ctx.points), None, None

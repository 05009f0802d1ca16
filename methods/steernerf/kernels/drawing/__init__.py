"""Both ends of the 2D renderer's network: what it is shown, and the picture that it corrects.

`shown` lays the features of all frames out at full resolution; `corrected` adds the output of the
network to the enlarged colours. Arrays are pictures [H, W, C], which convolutions read channels
last.
"""

from __future__ import annotations

from types import ModuleType

import torch
from torch import Tensor

from bench.types import check_shape
from methods.kernels.dispatch import implementation


def shown(
    present: Tensor,
    values: Tensor,
    index: Tensor,
    frames: int,
    *,
    dtype: torch.dtype | None = None,
    memory: Tensor | None = None,
    backend: str = "auto",
) -> Tensor:
    """Lay out the features of the present and L preceding `frames`: [H, W, K (L + 1)] of `dtype`
    (None: that of `present`), first the RGB of all frames, then their other features.

    `present` [h, w, K] stands at every s-th pixel; each pixel has the row of `values` [P, K] that
    `index` [L', H, W] int32 names, -1 for none, for L' <= L preceding frames, each with rows of its
    own. All else is 0.
    Differentiable in `present` and `values`; the gradient of a row is the sum over all pixels that
    show it. Without a gradient, a CPU writes the result into the beginning of `memory` [M], if that
    is given: fresh pages of the system take as long as the work itself.
    """
    check_shape("present", present, None, None, None)
    check_shape("values", values, None, present.shape[2])
    check_shape("index", index, None, None, None)
    chosen, given = _by(backend, present), (present, values, index.contiguous())
    return _Shown.apply(*given, frames, dtype or present.dtype, memory, chosen)


def corrected(
    rgb: Tensor,
    correction: Tensor,
    corner: tuple[int, int],
    scale: int,
    aligned: bool,
    *,
    clip: bool = False,
    backend: str = "auto",
) -> Tensor:
    """Enlarge `rgb` [h, w, 3] bilinearly to [h s, w s, 3], and add `correction` [H', W', 3] from
    the pixel `corner` (row, column) on; `clip` the sum to [0, 1].

    If `aligned`, every pixel stays in its place; if not, the corners of the picture do, as torch
    calls it. Differentiable in both tensors, unless clipped.
    """
    check_shape("rgb", rgb, None, None, 3)
    check_shape("correction", correction, None, None, 3)
    how, chosen = (corner, scale, aligned), _by(backend, rgb)
    if clip:
        return chosen.corrected(rgb.detach(), correction.detach(), *how, clip=True)
    return _Corrected.apply(rgb, correction, how, chosen)


def _by(backend: str, x: Tensor) -> ModuleType:
    return implementation(__name__, backend, x.device)


class _Shown(torch.autograd.Function):
    @staticmethod
    def forward(ctx, present, values, index, frames, dtype, memory, chosen):
        ctx.save_for_backward(index)
        ctx.chosen, ctx.dtype = chosen, present.dtype
        ctx.given = frames, present.shape[:2], len(values)
        moved = (x.detach().to(dtype).contiguous() for x in (present, values))
        if memory is None or any(ctx.needs_input_grad):
            memory = present.new_empty(0, dtype=dtype)
        return chosen.shown(*moved, index, frames, memory)

    @staticmethod
    def backward(ctx, grad):
        (index,) = ctx.saved_tensors
        grads = ctx.chosen.collected(grad.to(ctx.dtype).contiguous(), index, *ctx.given)
        return *grads, None, None, None, None, None


class _Corrected(torch.autograd.Function):
    @staticmethod
    def forward(ctx, rgb, correction, how, chosen):
        ctx.how, ctx.chosen = how, chosen
        ctx.sizes, ctx.dtype = (rgb.shape[:2], correction.shape[:2]), correction.dtype
        return chosen.corrected(rgb.detach(), correction.detach(), *how, clip=False)

    @staticmethod
    def backward(ctx, grad):
        size, (rows, columns) = ctx.sizes
        (top, left), scale, aligned = ctx.how
        base = None
        if ctx.needs_input_grad[0]:
            base = ctx.chosen.reduced(grad.contiguous(), size, scale, aligned)
        added = grad[top : top + rows, left : left + columns].to(ctx.dtype)
        return base, added, None, None

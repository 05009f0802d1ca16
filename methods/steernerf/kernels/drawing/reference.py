"""What the network is shown, and the picture that it corrects, in plain torch."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional


def shown(
    present: Tensor,
    values: Tensor,
    index: Tensor,
    frames: int,
    memory: Tensor,
) -> Tensor:
    """The features of all frames, [H, W, K (L + 1)]; `memory` is not used."""
    s, (preceding, height, width) = index.shape[1] // present.shape[0], index.shape
    every = present.new_zeros(frames + 1, height, width, present.shape[2])
    every[0, ::s, ::s] = present
    nothing = values.new_zeros(1, values.shape[1])  # the last row, that of index -1
    every[1 : preceding + 1] = torch.cat((values, nothing))[index.long()]
    parts = every[..., :3], every[..., 3:]
    return torch.cat([part.permute(1, 2, 0, 3).flatten(2) for part in parts], dim=2)


def collected(
    grad: Tensor, index: Tensor, frames: int, size: tuple[int, int], points: int
) -> tuple[Tensor, Tensor]:
    """The adjoint: gradients of the present features [h, w, K], of `size` h, w, and of those of the
    `points`, [P, K], each the sum over the pixels that show it."""
    s, features = index.shape[1] // size[0], grad.shape[2] // (frames + 1)
    rgb, rest = grad.split((3 * (frames + 1), (features - 3) * (frames + 1)), dim=2)
    parts = rgb.unflatten(2, (-1, 3)), rest.unflatten(2, (frames + 1, -1))
    every = torch.cat(parts, dim=3).movedim(2, 0)  # [L + 1, H, W, K]
    sums = grad.new_zeros(points + 1, features)
    sums.index_put_((index.long(),), every[1 : len(index) + 1], accumulate=True)
    return every[0, ::s, ::s], sums[:-1]


def corrected(
    rgb: Tensor,
    correction: Tensor,
    corner: tuple[int, int],
    scale: int,
    aligned: bool,
    *,
    clip: bool,
) -> Tensor:
    """The corrected picture [h s, w s, 3]."""
    given = rgb.permute(2, 0, 1)[None]
    size = tuple(scale * side for side in rgb.shape[:2])
    base = functional.interpolate(given, size, mode="bilinear", align_corners=not aligned)
    picture = base[0].permute(1, 2, 0).contiguous()
    (top, left), (height, width) = corner, correction.shape[:2]
    picture[top : top + height, left : left + width] += correction
    return picture.clamp_(0, 1) if clip else picture


def reduced(grad: Tensor, size: tuple[int, int], scale: int, aligned: bool) -> Tensor:
    """The gradient of the colours, of `size` h, w: the adjoint of enlarging them."""
    given, sizes = grad.permute(2, 0, 1)[None], (list(grad.shape[:2]), [1, 3, *size])
    found = torch.ops.aten.upsample_bilinear2d_backward(given, *sizes, not aligned)
    return found[0].permute(1, 2, 0)

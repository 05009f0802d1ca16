"""Corner features in plain torch, differentiable in table and weights."""

from torch import Tensor


def corner_gather(
    table: Tensor, corners: Tensor, voxel: Tensor, weights: Tensor, grad_buffer: Tensor | None
) -> Tensor:
    if grad_buffer is not None:
        table.register_hook(grad_buffer.add_)
    values = table[corners[voxel.long()].long()].to(weights.dtype)  # [S, 8, F]
    return (weights[..., None] * values).sum(dim=1)

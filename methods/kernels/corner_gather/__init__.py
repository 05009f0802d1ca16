"""Features of a voxel grid, gathered from the eight corners of a voxel with given weights.

Corner c of a voxel is at +x if bit 0 of c is set, at +y for bit 1, at +z for bit 2. Local
coordinates go from 0 to 1 along each axis of a voxel. With the weights of `trilinear`, the result
is the trilinear interpolant at a point.
"""

import torch
from torch import Tensor

from bench.types import check_shape
from methods.kernels.dispatch import implementation
from methods.kernels.types import expect

CORNERS = 8
OFFSETS = torch.arange(CORNERS)[:, None] >> torch.arange(3) & 1  # [8, 3] of the corners of a voxel


def corner_gather(
    table: Tensor,
    corners: Tensor,
    voxel: Tensor,
    weights: Tensor,
    *,
    grad_buffer: Tensor | None = None,
    backend: str = "auto",
) -> Tensor:
    """Sums over c of weights[s, c] table[corners[voxel[s], c]]: features [S, F] of S samples.

    Differentiable in a float32 `table`; in `weights`, and with other types, only with
    backend="reference".

    Args:
        table: [C, F] features of the corners.
        corners: [V, 8] int32 rows of `table` for each voxel's corners. Not checked.
        voxel: [S] int32 rows of `corners`; checked on a CPU.
        weights: [S, 8] weights of the corners; a NaN only affects the features of its sample.
        grad_buffer: [C, F]; if given, the gradient of `table` is added to it in place and hidden
            from autograd, so that a training step neither allocates nor clears a second table.
    """
    check_shape("table", table, None, None)
    check_shape("corners", corners, None, CORNERS)
    check_shape("voxel", voxel, None)
    check_shape("weights", weights, len(voxel), CORNERS)
    if grad_buffer is not None:
        check_shape("grad_buffer", grad_buffer, *table.shape)
        table = table.detach().requires_grad_()  # otherwise there may be no backward pass
    if len(voxel) and voxel.device.type == "cpu":  # on a GPU the check would wait
        low, high = (int(end) for end in torch.aminmax(voxel))
        rows, found = f"rows of the {len(corners)} voxels", f"{low} to {high}"
        expect(0 <= low <= high < len(corners), "voxel", rows, found)
    kernel = implementation(__name__, backend, table.device)
    return kernel.corner_gather(table, corners, voxel, weights, grad_buffer)


def trilinear(local: Tensor) -> Tensor:
    """Weights [S, 8] of the corners at points with local coordinates `local` [S, 3], in plain
    torch; differentiable."""
    check_shape("local", local, None, 3)
    x, y, z = torch.stack((1 - local, local), dim=1).unbind(dim=2)  # [S, 2], below and above
    across = z[:, :, None] * y[:, None]  # [S, 2, 2]
    return (across[..., None] * x[:, None, None]).flatten(1)

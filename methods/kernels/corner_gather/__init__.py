"""Features of a voxel grid, gathered from the eight corners of a voxel with given weights.

Corner c of a voxel is at +x if bit 0 of c is set, at +y for bit 1, at +z for bit 2. Local
coordinates go from 0 to 1 along each axis of a voxel. With the weights of `trilinear`, the result
is the trilinear interpolant at a point; with those of `integral`, its mean over a segment.
"""

from __future__ import annotations

import torch
from torch import Tensor

from bench.types import Rays, check_shape
from methods.kernels.dispatch import implementation
from methods.kernels.voxel_walk import Crossings, Voxels

CORNERS = 8


def gather(
    table: Tensor,
    corners: Tensor,
    voxel: Tensor,
    weights: Tensor,
    *,
    grad_buffer: Tensor | None = None,
    backend: str = "auto",
) -> Tensor:
    """Sums over c of weights[s, c] table[corners[voxel[s], c]]: features [S, F] of S samples.

    Differentiable in a float32 `table`; in `weights` only with backend="reference".

    Args:
        table: [C, F] features of the corners; bfloat16 is read directly, but has no gradient.
        corners: [V, 8] int32 rows of `table` for each voxel's corners. Not checked.
        voxel: [S] int32 rows of `corners`.
        weights: [S, 8] weights of the corners; a NaN only affects the features of its sample.
        grad_buffer: [C, F]; if given, the gradient of `table` is added to it in place and hidden
            from autograd, so that a training step neither allocates nor clears a second table.

    Raises:
        ValueError: wrong shapes; on a CPU, a voxel that is not a row of `corners`; other types than
            float32 for the backend "cpu".
    """
    check_shape("table", table, None, None)
    check_shape("corners", corners, None, CORNERS)
    check_shape("voxel", voxel, None)
    check_shape("weights", weights, len(voxel), CORNERS)
    if grad_buffer is not None:
        check_shape("grad_buffer", grad_buffer, *table.shape)
        if not table.requires_grad:
            table = table.detach().requires_grad_()  # otherwise there is no backward pass
    if len(voxel) and voxel.device.type == "cpu":  # on a GPU the check would wait
        low, high = (int(end) for end in torch.aminmax(voxel))
        if not 0 <= low <= high < len(corners):
            raise ValueError(
                f"voxel: expected rows of the {len(corners)} voxels, got {low} to {high}"
            )
    return implementation(__name__, backend, table.device).gather(
        table, corners, voxel, weights, grad_buffer=grad_buffer
    )


def trilinear(local: Tensor, *, backend: str = "auto") -> Tensor:
    """Weights [S, 8] of the corners at points with local coordinates `local` [S, 3].

    Differentiable with backend="reference" only.

    Raises:
        ValueError: a shape other than this; backend "cpu": not float32.
    """
    check_shape("local", local, None, 3)
    return implementation(__name__, backend, local.device).trilinear(local)


def integral(entry: Tensor, leave: Tensor, *, backend: str = "auto") -> Tensor:
    """Weights [S, 8] of the mean of the trilinear interpolant between two points of a voxel.

    They give its integral along the segment, divided by the length of the segment (Wu et al. 2022,
    Section 3.2). For a segment of length 0 they are those of the point. Differentiable with
    backend="reference" only.

    Args:
        entry: [S, 3] local coordinates of one end.
        leave: [S, 3] local coordinates of the other end.

    Raises:
        ValueError: a shape other than these; backend "cpu": not float32.
    """
    check_shape("entry", entry, None, 3)
    check_shape("leave", leave, len(entry), 3)
    return implementation(__name__, backend, entry.device).integral(entry, leave)


def integral_along(
    rays: Rays, crossings: Crossings, voxels: Voxels, *, backend: str = "auto"
) -> Tensor:
    """Weights [S, 8] of `integral` over the `crossings` of R `rays` through `voxels`.

    Not differentiable.

    Raises:
        ValueError: rays or voxels do not belong to the crossings; backend "cpu": not
            float32.
    """
    count = len(rays.origins)
    check_shape("origins", rays.origins, count, 3)
    check_shape("directions", rays.directions, count, 3)
    if len(crossings.offsets) != count + 1:
        raise ValueError(
            f"crossings: expected those of the {count} rays, got of {len(crossings.offsets) - 1}"
        )
    return implementation(__name__, backend, rays.origins.device).integral_along(
        rays, crossings, voxels
    )

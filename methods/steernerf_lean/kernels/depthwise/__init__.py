"""Sparse depthwise 3 x 3 convolution: computed only for cells, which cover little of a picture.

y[n, c] = sum_k weight[k, c] x[neighbours[n, k], c], where a neighbour of -1 counts as 0. For the
cells this equals a dense convolution on a picture that is 0 elsewhere.
"""

from __future__ import annotations

import torch
from torch import Tensor

from bench.types import check_shape
from methods.kernels.dispatch import implementation

TAPS = 9  # number of neighbours of a cell, row by row, including the cell itself in the middle


def neighbours_of(cells: Tensor, count: int | None = None) -> Tensor:
    """Indices of the cells around each of the `cells` [B, h, w] bool: [N, 9] int32, -1 for none.
    Cells are numbered from 0, row by row, picture by picture; N is `count`, or None: it is counted,
    which waits for a GPU."""
    check_shape("cells", cells, None, None, None)
    batch, height, width = cells.shape
    number = torch.full((batch, height + 2, width + 2), -1, dtype=torch.int32, device=cells.device)
    where = cells.nonzero() if count is None else torch.nonzero_static(cells, size=count)
    picture, row, column = where.unbind(dim=1)
    number[picture, row + 1, column + 1] = torch.arange(
        len(where), dtype=torch.int32, device=cells.device
    )
    middle = (picture * (height + 2) + row + 1) * (width + 2) + column + 1
    around = torch.arange(-1, 2, device=cells.device)
    offsets = (around[:, None] * (width + 2) + around).flatten()
    return number.flatten()[middle[:, None] + offsets]


def depthwise(x: Tensor, neighbours: Tensor, weight: Tensor, *, backend: str = "auto") -> Tensor:
    """Convolve the cells `x` [N, C] with `weight` [9, C]; differentiable in both. `neighbours` [N,
    9] int32 are those of `neighbours_of`; the relation must be symmetric."""
    check_shape("x", x, None, None)
    check_shape("neighbours", neighbours, len(x), TAPS)
    check_shape("weight", weight, TAPS, x.shape[1])
    return implementation(__name__, backend, x.device).depthwise(x, neighbours, weight)

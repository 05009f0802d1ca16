"""Refinement: the field itself renders the cells with the largest estimated error."""

from __future__ import annotations

import math

from torch import Tensor

from bench.cameras import cast
from bench.types import Rays
from methods.steernerf.view import View
from methods.steernerf_lean.cells import centres


def worst_cells(error: Tensor, share: float) -> Tensor:
    """Indices of the `share` of N cells with the largest estimated `error` [N]."""
    return error.topk(math.ceil(share * len(error)), sorted=False).indices


def rays_of_cells(cells: Tensor, view: View) -> Rays:
    """Rays through all pixels of `cells` [n], cell by cell: n s^2 of them."""
    return cast(view.full, centres(cells, view.low.width, view.scale).flatten(0, 1))

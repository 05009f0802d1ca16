"""Refinement: the field itself renders the cells with the largest estimated error."""

from __future__ import annotations

import math

from torch import Tensor

from bench.cameras import cast
from bench.types import Rays
from methods.rendering.frame import FeatureFrame
from methods.rendering.sampling import Sampling
from methods.steernerf.options import Rendering
from methods.steernerf.view import View
from methods.steernerf_lean.cells import centres
from methods.steernerf_lean.window import depths_around


def worst_cells(error: Tensor, share: float) -> Tensor:
    """Indices of the `share` of N cells with the largest estimated `error` [N]."""
    return error.topk(math.ceil(share * len(error)), sorted=False).indices


def rays_of_cells(cells: Tensor, view: View) -> Rays:
    """Rays through all pixels of `cells` [n], cell by cell: n s^2 of them."""
    return cast(view.full, centres(cells, view.low.width, view.scale).flatten(0, 1))


def refined_sampling(
    cells: Tensor, frame: FeatureFrame, scale: int, rendering: Rendering
) -> Sampling:
    """How the rays of `cells` [n] are marched.

    With range reduction in mode "window" they are sampled only near the depths of the
    low-resolution `frame` around their cell.
    """
    how = rendering.refined_sampling
    if rendering.range.mode != "window":
        return how
    # Twice epsilon: between low-resolution pixels the surface may lie farther off.
    window = depths_around(frame.depth, 2 * rendering.range.epsilon).view(-1, 2)[cells]
    return how.within(window.repeat_interleave(scale**2, dim=0))

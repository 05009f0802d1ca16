"""Refinement: the cells with the largest estimated error are rendered by the field after all."""

from __future__ import annotations

import math

from torch import Tensor

from bench.cameras import cast
from bench.types import Rays
from methods.rendering.frame import FeatureFrame
from methods.rendering.march import March
from methods.steernerf.beyond.cells import centres
from methods.steernerf.beyond.window import depths_around
from methods.steernerf.options import Rendering
from methods.steernerf.view import View


def worst_cells(error: Tensor, share: float) -> Tensor:
    """Which of N cells, `share` of them, have the largest estimated `error` [N]."""
    return error.topk(math.ceil(share * len(error)), sorted=False).indices


def rays_of_cells(cells: Tensor, view: View) -> Rays:
    """A ray through each pixel of `cells` [n], cell by cell: n s^2."""
    return cast(view.full, centres(cells, view.low.width, view.scale).flatten(0, 1))


def refined_march(cells: Tensor, frame: FeatureFrame, scale: int, rendering: Rendering) -> March:
    """How the rays of `cells` [n] are marched.

    With range reduction in mode "window" they look where the low-resolution `frame` has something
    around their cell.
    """
    how = rendering.refined_march
    if rendering.range.mode != "window":
        return how
    # Between the samples of the frame a surface may lie farther off.
    window = depths_around(frame.depth, 2 * rendering.range.epsilon).view(-1, 2)[cells]
    return how.within(window.repeat_interleave(scale**2, dim=0))

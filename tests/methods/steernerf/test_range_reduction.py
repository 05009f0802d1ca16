"""Range reduction, on solids whose surface is known."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from bench.types import Camera
from methods.kernels.types import Occupancy
from methods.rendering.frame import FeatureFrame, everywhere, render_frame
from methods.rendering.occupancy import STEP
from methods.rendering.sampling import Sampling
from methods.steernerf.buffer import CLEAR_ALPHA, Cloud
from methods.steernerf.options import RangeReduction
from tests.methods.conftest import Work, look_at_the_middle
from tests.methods.solids import Solid, ball, wall

EVERYWHERE = Occupancy(torch.ones(32, 32, 32, dtype=torch.bool))
EPSILON = 0.03
SIZE = 16


def along_x() -> Camera:
    """Looks along x from x = -1.1; sees nothing but walls, up to x = 0.8."""
    c2w = torch.tensor([[0.0, 0, 1, -1.1], [-1, 0, 0, 0.5], [0, -1, 0, 0.5]])
    lens = {"cx": SIZE / 2, "cy": SIZE / 2, "fx": 40.0, "fy": 40.0}
    return replace(look_at_the_middle(0.0, 0.3), c2w=c2w, width=SIZE, height=SIZE, **lens)


def render(field: Solid, interval: Tensor | None = None) -> tuple[FeatureFrame, int]:
    """The frame, in the interval [h, w, 2] or everywhere, and how many samples it took."""
    probe, how = Work(), Sampling(step=4 * STEP)
    if interval is not None:
        how = how.within(interval.view(-1, 2))
    by = everywhere(field, EVERYWHERE, probe, how)
    return render_frame(along_x(), EVERYWHERE, torch.ones(4), probe, by), probe.done["samples"]


def interval_of(frame: FeatureFrame) -> Tensor:
    """Of a camera that stays where it is."""
    return Cloud.of(frame).expected().interval(along_x(), EPSILON, "cpu")


def test_a_surface_is_found_inside_the_interval_alone() -> None:
    whole, samples = render(Solid(wall(0.3)))
    interval = interval_of(whole)
    assert interval.isfinite().all()
    # Where the surface stayed it is found, all of it, with fewer samples.
    same, fewer = render(Solid(wall(0.3)), interval)
    torch.testing.assert_close(same.values, whole.values, rtol=0, atol=1e-5)
    assert fewer < 0.5 * samples
    # Where it moved, nothing is made up for what is missing.
    moved, _ = render(Solid(wall(0.7)), interval)
    assert not moved.alpha.any()
    assert (moved.values == 1).all()  # the background


def test_the_interval_is_that_of_the_pixel_alone_and_everything_where_nothing_is_known() -> None:
    frame, _ = render(Solid(ball()))
    interval = interval_of(frame)
    seen = frame.alpha > CLEAR_ALPHA
    assert torch.equal(interval[..., 1].isfinite(), seen)
    assert 0 < seen.sum() < SIZE**2
    assert (interval[~seen][:, 0] == 0).all()
    middle = interval[seen].mean(dim=-1)
    torch.testing.assert_close(middle, frame.depth[seen], rtol=0, atol=1e-5)
    width = interval[seen].diff(dim=-1).squeeze(-1)
    torch.testing.assert_close(width, torch.full_like(width, 2 * EPSILON), rtol=0, atol=1e-6)


@pytest.mark.parametrize("epsilon", [0.0, -1.0, math.nan])
def test_an_interval_has_a_width(epsilon: float) -> None:
    with pytest.raises(ValueError, match=r"range\.epsilon: expected more than 0, got"):
        RangeReduction("paper", epsilon, "sum")

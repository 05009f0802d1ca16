"""Range reduction, on solids whose surface is known: the paper's interval, and a window of depths
with a way out."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from bench.types import Camera
from methods.kernels.types import Occupancy
from methods.rendering.field import ROUND_SAMPLES
from methods.rendering.frame import FeatureFrame, everywhere, render_frame
from methods.rendering.occupancy import STEP
from methods.rendering.sampling import Sampling
from methods.steernerf.buffer import Cloud
from methods.steernerf.options import RangeReduction, Reprojection
from methods.steernerf.range_reduction import depth_interval
from methods.steernerf_lean.window import EDGE, KEPT_ALPHA, DepthPrior, depth_prior, within
from tests.methods.conftest import Work, look_at_the_middle
from tests.methods.solids import Solid, ball, slab, wall

EXACT = Reprojection()
EVERYWHERE = Occupancy(torch.ones(32, 32, 32, dtype=torch.bool))
WHITE = torch.ones(4)
EPSILON = 0.03
LONG = 4 * STEP
SIZE = 16
FOCAL = 40.0


def at_ball(turn: float) -> Camera:
    """Sees the ball, which fills most of the picture."""
    middle = SIZE / 2
    camera = look_at_the_middle(turn, 0.3)
    return replace(camera, cx=middle, cy=middle, fx=FOCAL, fy=FOCAL, width=SIZE, height=SIZE)


def along_x(shift: float = 0.0) -> Camera:
    """Looks along x from x = -1.1; sees nothing but walls, up to x = 0.8."""
    c2w = torch.tensor([[0.0, 0, 1, -1.1], [-1, 0, 0, 0.5 + shift], [0, -1, 0, 0.5]])
    return replace(at_ball(0.0), c2w=c2w)


def render(
    field: Solid,
    camera: Camera,
    where: DepthPrior | Tensor | None = None,
    occupancy: Occupancy = EVERYWHERE,
    how: Sampling = Sampling(step=LONG),  # noqa: B008
    background: Tensor = WHITE,
) -> tuple[FeatureFrame, int]:
    """The frame, and how many samples it took: where a depth prior says, in the interval [h, w, 2]
    of the paper, or everywhere."""
    probe = Work()
    if isinstance(where, DepthPrior):
        by = within(field, occupancy, probe, how, where)
    else:
        how = how if where is None else how.within(where.view(-1, 2))
        by = everywhere(field, occupancy, probe, how)
    frame = render_frame(camera, occupancy, background, probe, by)
    return frame, probe.done["samples"]


def seen_before(
    field: Solid, before: Camera, camera: Camera, epsilon: float = EPSILON
) -> DepthPrior:
    """What a frame of `field` at `before` says of `camera`."""
    return depth_prior(cloud_of(field, before), camera, epsilon, EXACT, "cpu")


def cloud_of(field: Solid, camera: Camera) -> Cloud:
    return Cloud.of(render(field, camera)[0], EXACT)


def is_known(window: Tensor) -> Tensor:
    return window[..., 1].isfinite()


@pytest.mark.parametrize("moved", [0.0, 0.003, 0.01])
def test_a_picture_within_windows_is_the_whole_one_with_fewer_samples(moved: float) -> None:
    field, camera, epsilon = Solid(ball()), at_ball(0.2 + moved), 2 * EPSILON
    whole, all_samples = render(field, camera)
    found = seen_before(field, at_ball(0.2), camera, epsilon)
    reduced, samples = render(field, camera, found)
    # A share of at most 1 - KEPT_ALPHA of a pixel's weight is missing, and given to others, of
    # features in [0, 1] and a depth within the window.
    missing = 1 - KEPT_ALPHA + 1e-4
    torch.testing.assert_close(reduced.alpha, whole.alpha, rtol=0, atol=missing)
    torch.testing.assert_close(reduced.values, whole.values, rtol=0, atol=missing)
    both = whole.depth.isfinite() & reduced.depth.isfinite()
    assert both.sum() == whole.depth.isfinite().sum() > 100
    width = (2 + EDGE) * epsilon
    torch.testing.assert_close(reduced.depth[both], whole.depth[both], rtol=0, atol=missing * width)
    # The samples of pixels that are unknown, background for the most part, stay as they are.
    assert samples < 0.8 * all_samples
    inside = is_known(found.window) & (whole.alpha > 0.99)
    assert inside.sum() > 0.5 * (whole.alpha > 0.99).sum()


def test_a_window_spares_what_lies_in_front_of_the_surface() -> None:
    field, camera = Solid(wall(0.5)), along_x()
    _, all_samples = render(field, camera)
    found = seen_before(field, camera, camera)
    assert is_known(found.window).all()
    _, samples = render(field, camera, found)
    # Of the half cube in front only epsilon is left; a ray goes on for a round behind the surface.
    rays, slant = SIZE**2, math.hypot(1, 0.2, 0.2)
    assert samples <= rays * (slant * EPSILON / LONG + 1 + ROUND_SAMPLES)
    assert all_samples >= rays * 0.5 / LONG


def test_a_still_camera_expects_what_it_saw() -> None:
    field, camera = Solid(ball()), at_ball(0.2)
    frame, _ = render(field, camera)
    found = seen_before(field, camera, camera)
    known = is_known(found.window)
    # The window holds the depth, with epsilon to spare on either side.
    low, high = (bound[known] for bound in found.window.unbind(dim=-1))
    seen = frame.alpha[known] > 0.1
    error = 1e-5
    assert (low[seen] <= frame.depth[known][seen] - EPSILON + error).all()
    assert (high[seen] >= frame.depth[known][seen] + EPSILON - error).all()
    assert (found.alpha[known][seen] >= frame.alpha[known][seen]).all()
    assert (high - low <= (2 + EDGE) * EPSILON + error).all()
    assert (low[~seen] < high[~seen]).all()


def test_a_surface_that_is_gone_is_looked_for_behind_its_window() -> None:
    camera = along_x()
    found = seen_before(Solid(wall(0.3)), camera, camera)
    assert is_known(found.window).all()
    now = Solid(wall(0.7))
    whole, _ = render(now, camera)
    reduced, samples = render(now, camera, found)
    # The same samples, in other rounds.
    torch.testing.assert_close(reduced.values, whole.values, rtol=0, atol=1e-5)
    torch.testing.assert_close(reduced.depth, whole.depth, rtol=0, atol=1e-5)
    assert samples < render(now, camera)[1]


def test_nothing_is_found_outside_the_interval_of_the_paper() -> None:
    camera = along_x()
    cloud = cloud_of(Solid(wall(0.3)), camera)
    interval = depth_interval(cloud, camera, EPSILON, EXACT, "cpu")
    assert is_known(interval).all()
    reduced, _ = render(Solid(wall(0.7)), camera, interval)
    assert not reduced.alpha.any()
    assert (reduced.values == 1).all()  # the background
    # Where the surface stayed it is found, all of it: nothing is made up for what is missing.
    same, _ = render(Solid(wall(0.3)), camera, interval)
    whole, _ = render(Solid(wall(0.3)), camera)
    torch.testing.assert_close(same.values, whole.values, rtol=0, atol=1e-5)


def test_the_interval_of_the_paper_is_that_of_the_pixel_alone() -> None:
    camera = along_x()
    frame, _ = render(Solid(ball()), camera)
    cloud = Cloud.of(frame, EXACT)
    interval = depth_interval(cloud, camera, EPSILON, EXACT, "cpu")
    seen = frame.alpha > 0.1
    assert torch.equal(is_known(interval), seen)
    assert (interval[~seen][:, 0] == 0).all()  # everything, where nothing is known
    middle = interval[seen].mean(dim=-1)
    torch.testing.assert_close(middle, frame.depth[seen], rtol=0, atol=1e-5)
    width = interval[seen].diff(dim=-1).squeeze(-1)
    torch.testing.assert_close(width, torch.full_like(width, 2 * EPSILON), rtol=0, atol=1e-6)


def test_what_was_not_seen_before_is_looked_at_everywhere() -> None:
    # The near wall ends at y = 0.5; what it hid of the far one comes into view.
    field = Solid(slab(0.3, 0.32, until_y=0.5), wall(0.8))
    before, camera = along_x(0.0), along_x(0.3)
    found = seen_before(field, before, camera)
    assert 0.02 < (~is_known(found.window)).float().mean() < 0.5
    unknown = found.window[~is_known(found.window)]
    assert (unknown[:, 0] == 0).all()
    whole, _ = render(field, camera)
    reduced, _ = render(field, camera, found)
    error = (reduced.values - whole.values).abs().amax(dim=-1)
    missing = 1 - KEPT_ALPHA + 1e-4
    assert (error[~is_known(found.window)] < 1e-5).all()
    assert (error < missing).all()


@pytest.mark.parametrize(("step", "known"), [(0.9 * EDGE, True), (1.1 * EDGE, False)])
def test_a_pixel_at_a_depth_edge_is_looked_at_everywhere(step: float, known: bool) -> None:
    camera = along_x()
    depth = torch.full((SIZE, SIZE), 1.5)
    depth[:, 8:] += step * EPSILON
    frame = FeatureFrame(camera, torch.zeros(SIZE, SIZE, 4), depth, torch.ones(SIZE, SIZE))
    cloud = Cloud.of(frame, EXACT)
    found = depth_prior(cloud, camera, EPSILON, EXACT, "cpu")
    expected = torch.ones(SIZE, SIZE, dtype=torch.bool)
    expected[:, 7:9] = known
    assert torch.equal(is_known(found.window), expected)
    if known:
        edge = torch.tensor((1.5 - EPSILON, 1.5 + (step + 1) * EPSILON))
        torch.testing.assert_close(found.window[:, 7:9], edge.expand(SIZE, 2, 2), atol=1e-5, rtol=0)
    # To the paper's interval an edge makes no difference.
    assert is_known(depth_interval(cloud, camera, EPSILON, EXACT, "cpu")).all()


def test_a_ray_that_finds_less_than_expected_goes_on() -> None:
    camera = along_x()
    thick = Solid(wall(0.3))
    thin_then_thick = Solid(slab(0.3, 0.33), wall(0.7), density=25.0)  # half opaque: 25 * 0.03
    found = seen_before(thick, camera, camera)
    whole, _ = render(thin_then_thick, camera)
    reduced, _ = render(thin_then_thick, camera, found)
    torch.testing.assert_close(reduced.values, whole.values, rtol=0, atol=1e-4)
    torch.testing.assert_close(reduced.alpha, whole.alpha, rtol=0, atol=1e-4)


def test_a_thin_surface_that_was_thin_before_ends_its_rays() -> None:
    camera = along_x()
    field = Solid(slab(0.3, 0.33), density=25.0)
    found = seen_before(field, camera, camera)
    whole, all_samples = render(field, camera)
    reduced, samples = render(field, camera, found)
    assert 0.4 < whole.alpha.min() < whole.alpha.max() < 0.65
    # A ray takes a sample more or less than its neighbour, of which it expects as much, and may
    # miss a share of 1 - KEPT_ALPHA.
    sample = 1 - math.exp(-25 * LONG)
    torch.testing.assert_close(reduced.alpha, whole.alpha, rtol=0, atol=sample + 1 - KEPT_ALPHA)
    # Those that took as many as their neighbours end, the others look through the whole cube.
    assert samples < 0.5 * all_samples


def test_a_faint_surface_that_was_faint_before_keeps_its_colour() -> None:
    camera = along_x()
    veil = Solid(slab(0.3, 0.36), density=2.0)  # 11 % opaque, a third of a percent a sample
    found = seen_before(veil, camera, camera)
    assert is_known(found.window).all()
    black = torch.zeros(4)
    frame, _ = render(veil, camera, found, how=Sampling(stop=1e-2), background=black)
    assert frame.alpha.min() > 0.1
    torch.testing.assert_close(frame.values[..., 3], 0.25 * frame.alpha, rtol=0, atol=1e-6)


def test_an_empty_frame_says_nothing_of_any_depth() -> None:
    camera = along_x()
    found = seen_before(Solid(lambda x: -x[:, 0] - 1), camera, camera)
    assert not is_known(found.window).any()
    assert not found.window[..., 0].any()
    assert not found.alpha.any()
    field = Solid(ball())
    whole, all_samples = render(field, camera)
    reduced, samples = render(field, camera, found)
    assert torch.equal(reduced.values, whole.values)
    assert samples == all_samples


def test_pixels_without_opacity_say_nothing_of_a_depth() -> None:
    """Those of the release's clouds: points at the camera that expect nothing."""
    camera = along_x()
    depth = torch.full((SIZE, SIZE), 1.5)
    cloud = Cloud.of(
        FeatureFrame(camera, torch.zeros(SIZE, SIZE, 4), depth, torch.ones(SIZE, SIZE)), EXACT
    )
    cloud = replace(cloud, alpha=torch.zeros_like(cloud.alpha))
    found = depth_prior(cloud, camera, EPSILON, EXACT, "cpu")
    assert not is_known(found.window).any()


def test_nothing_is_rendered_where_no_cell_is_occupied() -> None:
    nowhere = Occupancy(torch.zeros(32, 32, 32, dtype=torch.bool))
    camera, field = along_x(), Solid(wall(0.3))
    frame, samples = render(field, camera, seen_before(field, camera, camera), nowhere)
    assert samples == 0
    assert (frame.values == 1).all()
    assert frame.depth.isinf().all()


@pytest.mark.parametrize("epsilon", [0.0, -1.0, math.nan])
def test_a_window_has_a_width(epsilon: float) -> None:
    with pytest.raises(ValueError, match=r"range\.epsilon: expected more than 0, got"):
        RangeReduction(epsilon=epsilon)

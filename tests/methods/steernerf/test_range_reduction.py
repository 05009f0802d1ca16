"""Range reduction, on solids whose surface is known."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from bench.types import Camera
from methods.kernels.march import Occupancy
from methods.rendering.batch import FeatureFrame
from methods.rendering.occupancy import STEP
from methods.rendering.rays import ROUND_SAMPLES
from methods.steernerf.buffer import Cloud, Reprojection
from methods.steernerf.range_reduction import EDGE, KEPT_ALPHA, Evidence, RangeReduction, evidence
from methods.steernerf.range_reduction import render_guided as render_guided_by
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
    field: Solid, camera: Camera, found: Evidence | None = None, occupancy: Occupancy = EVERYWHERE
) -> tuple[FeatureFrame, int]:
    """The frame, and how many samples it took."""
    probe = Work()
    frame = render_guided_by(field, camera, occupancy, WHITE, probe, found, step=LONG)
    return frame, probe.done["samples"]


def seen_before(
    field: Solid, before: Camera, camera: Camera, options: RangeReduction | None = None
) -> Evidence:
    """What a frame of `field` at `before` says of `camera`."""
    cloud = Cloud.of(render(field, before)[0], EXACT)
    return evidence(cloud, camera, options or RangeReduction("window", EPSILON), EXACT, "cpu")


def is_known(found: Evidence) -> Tensor:
    return found.window[..., 1].isfinite()


@pytest.mark.parametrize("moved", [0.0, 0.003, 0.01])
def test_a_guided_picture_is_the_whole_one_with_fewer_samples(moved: float) -> None:
    field, camera, epsilon = Solid(ball()), at_ball(0.2 + moved), 2 * EPSILON
    whole, all_samples = render(field, camera)
    found = seen_before(field, at_ball(0.2), camera, RangeReduction("window", epsilon))
    guided, samples = render(field, camera, found)
    # A share of at most 1 - KEPT_ALPHA of a pixel's weight is missing, and given to others, of
    # features in [0, 1] and a depth within the window.
    missing = 1 - KEPT_ALPHA + 1e-4
    torch.testing.assert_close(guided.alpha, whole.alpha, rtol=0, atol=missing)
    torch.testing.assert_close(guided.values, whole.values, rtol=0, atol=missing)
    both = whole.depth.isfinite() & guided.depth.isfinite()
    assert both.sum() == whole.depth.isfinite().sum() > 100
    width = (2 + EDGE) * epsilon
    torch.testing.assert_close(guided.depth[both], whole.depth[both], rtol=0, atol=missing * width)
    # The samples of pixels that are unknown, background for the most part, stay as they are.
    assert samples < 0.8 * all_samples
    inside = is_known(found) & (whole.alpha > 0.99)
    assert inside.sum() > 0.5 * (whole.alpha > 0.99).sum()


def test_a_window_spares_what_lies_in_front_of_the_surface() -> None:
    field, camera = Solid(wall(0.5)), along_x()
    _, all_samples = render(field, camera)
    found = seen_before(field, camera, camera)
    assert is_known(found).all()
    _, samples = render(field, camera, found)
    # Of the half cube in front only epsilon is left; a ray goes on for a round behind the surface.
    rays, slant = SIZE**2, math.hypot(1, 0.2, 0.2)
    assert samples <= rays * (slant * EPSILON / LONG + 1 + ROUND_SAMPLES)
    assert all_samples >= rays * 0.5 / LONG


def test_a_still_camera_expects_what_it_saw() -> None:
    field, camera = Solid(ball()), at_ball(0.2)
    frame, _ = render(field, camera)
    found = seen_before(field, camera, camera)
    known = is_known(found)
    assert not found.binding
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
    assert is_known(found).all()
    now = Solid(wall(0.7))
    whole, _ = render(now, camera)
    guided, samples = render(now, camera, found)
    # The same samples, in other rounds.
    torch.testing.assert_close(guided.values, whole.values, rtol=0, atol=1e-5)
    torch.testing.assert_close(guided.depth, whole.depth, rtol=0, atol=1e-5)
    assert samples < render(now, camera)[1]


def test_a_paper_window_is_binding() -> None:
    camera = along_x()
    options = RangeReduction("paper", EPSILON)
    found = seen_before(Solid(wall(0.3)), camera, camera, options)
    assert found.binding
    assert is_known(found).all()
    guided, _ = render(Solid(wall(0.7)), camera, found)
    assert not guided.alpha.any()
    assert (guided.values == 1).all()  # the background
    # Where the surface stayed it is found, all of it: nothing is made up for what is missing.
    same, _ = render(Solid(wall(0.3)), camera, found)
    whole, _ = render(Solid(wall(0.3)), camera)
    torch.testing.assert_close(same.values, whole.values, rtol=0, atol=1e-5)


def test_a_paper_window_is_that_of_the_pixel_alone() -> None:
    camera = along_x()
    frame, _ = render(Solid(ball()), camera)
    cloud = Cloud.of(frame, EXACT)
    found = evidence(cloud, camera, RangeReduction("paper", EPSILON), EXACT, "cpu")
    seen = frame.alpha > 0.1
    assert torch.equal(is_known(found), seen)
    middle = found.window[seen].mean(dim=-1)
    torch.testing.assert_close(middle, frame.depth[seen], rtol=0, atol=1e-5)
    width = found.window[seen].diff(dim=-1).squeeze(-1)
    torch.testing.assert_close(width, torch.full_like(width, 2 * EPSILON), rtol=0, atol=1e-6)
    assert torch.equal(found.alpha, torch.where(seen, frame.alpha, 0))


def test_what_was_not_seen_before_is_looked_at_everywhere() -> None:
    # The near wall ends at y = 0.5; what it hid of the far one comes into view.
    field = Solid(slab(0.3, 0.32, until_y=0.5), wall(0.8))
    before, camera = along_x(0.0), along_x(0.3)
    found = seen_before(field, before, camera)
    assert 0.02 < (~is_known(found)).float().mean() < 0.5
    unknown = found.window[~is_known(found)]
    assert (unknown[:, 0] == 0).all()
    whole, _ = render(field, camera)
    guided, _ = render(field, camera, found)
    error = (guided.values - whole.values).abs().amax(dim=-1)
    missing = 1 - KEPT_ALPHA + 1e-4
    assert (error[~is_known(found)] < 1e-5).all()
    assert (error < missing).all()


@pytest.mark.parametrize(("step", "known"), [(0.9 * EDGE, True), (1.1 * EDGE, False)])
def test_a_pixel_at_a_depth_edge_is_looked_at_everywhere(step: float, known: bool) -> None:
    camera = along_x()
    depth = torch.full((SIZE, SIZE), 1.5)
    depth[:, 8:] += step * EPSILON
    frame = FeatureFrame(camera, torch.zeros(SIZE, SIZE, 4), depth, torch.ones(SIZE, SIZE))
    found = evidence(
        Cloud.of(frame, EXACT), camera, RangeReduction("window", EPSILON), EXACT, "cpu"
    )
    expected = torch.ones(SIZE, SIZE, dtype=torch.bool)
    expected[:, 7:9] = known
    assert torch.equal(is_known(found), expected)
    if known:
        edge = torch.tensor((1.5 - EPSILON, 1.5 + (step + 1) * EPSILON))
        torch.testing.assert_close(found.window[:, 7:9], edge.expand(SIZE, 2, 2), atol=1e-5, rtol=0)
    # The paper's window knows no edges.
    paper = evidence(Cloud.of(frame, EXACT), camera, RangeReduction("paper", EPSILON), EXACT, "cpu")
    assert is_known(paper).all()


def test_a_ray_that_finds_less_than_expected_goes_on() -> None:
    camera = along_x()
    thick = Solid(wall(0.3))
    thin_then_thick = Solid(slab(0.3, 0.33), wall(0.7), density=25.0)  # half opaque: 25 * 0.03
    found = seen_before(thick, camera, camera)
    whole, _ = render(thin_then_thick, camera)
    guided, _ = render(thin_then_thick, camera, found)
    torch.testing.assert_close(guided.values, whole.values, rtol=0, atol=1e-4)
    torch.testing.assert_close(guided.alpha, whole.alpha, rtol=0, atol=1e-4)


def test_a_thin_surface_that_was_thin_before_ends_its_rays() -> None:
    camera = along_x()
    field = Solid(slab(0.3, 0.33), density=25.0)
    found = seen_before(field, camera, camera)
    whole, all_samples = render(field, camera)
    guided, samples = render(field, camera, found)
    assert 0.4 < whole.alpha.min() < whole.alpha.max() < 0.65
    # A ray takes a sample more or less than its neighbour, of which it expects as much, and may
    # miss a share of 1 - KEPT_ALPHA.
    sample = 1 - math.exp(-25 * LONG)
    torch.testing.assert_close(guided.alpha, whole.alpha, rtol=0, atol=sample + 1 - KEPT_ALPHA)
    # Those that took as many as their neighbours end, the others look through the whole cube.
    assert samples < 0.5 * all_samples


def test_a_faint_surface_that_was_faint_before_keeps_its_colour() -> None:
    camera = along_x()
    veil = Solid(slab(0.3, 0.36), density=2.0)  # 11 % opaque, a third of a percent a sample
    found = seen_before(veil, camera, camera)
    assert is_known(found).all()
    frame = render_guided_by(
        veil, camera, EVERYWHERE, torch.zeros(4), Work(), found, stop=1e-2, step=STEP
    )
    assert frame.alpha.min() > 0.1
    torch.testing.assert_close(frame.values[..., 3], 0.25 * frame.alpha, rtol=0, atol=1e-6)


def test_the_evidence_of_an_empty_frame_is_unknown_everywhere() -> None:
    camera = along_x()
    found = seen_before(Solid(lambda x: -x[:, 0] - 1), camera, camera)
    assert not is_known(found).any()
    assert not found.window[..., 0].any()
    assert not found.alpha.any()
    field = Solid(ball())
    whole, all_samples = render(field, camera)
    guided, samples = render(field, camera, found)
    assert torch.equal(guided.values, whole.values)
    assert samples == all_samples


def test_pixels_without_opacity_are_no_evidence() -> None:
    """Those of the release's clouds: points at the camera that expect nothing."""
    camera = along_x()
    depth = torch.full((SIZE, SIZE), 1.5)
    cloud = Cloud.of(
        FeatureFrame(camera, torch.zeros(SIZE, SIZE, 4), depth, torch.ones(SIZE, SIZE)), EXACT
    )
    cloud = replace(cloud, alpha=torch.zeros_like(cloud.alpha))
    found = evidence(cloud, camera, RangeReduction("window", EPSILON), EXACT, "cpu")
    assert not is_known(found).any()


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

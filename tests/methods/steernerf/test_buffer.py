"""Preceding frames: what is kept of them, which pixels of another view show their points, and range
reduction, on solids whose surface is known."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from bench.cameras import project, scale_camera
from bench.types import Camera
from methods.kernels.types import Occupancy
from methods.rendering.frame import FeatureFrame, everywhere, render_frame
from methods.rendering.occupancy import STEP
from methods.rendering.sampling import Sampling
from methods.steernerf.buffer import RELIABLE_ALPHA, PointCloud
from tests.common import assert_near
from tests.methods.conftest import Work, look_at_the_middle
from tests.methods.models import RELEASE
from tests.methods.solids import Solid, ball, wall


def frame_of(camera: Camera, depth: Tensor | None = None, alpha: float = 1.0) -> FeatureFrame:
    """A wavy surface of features that all differ."""
    shape = camera.height, camera.width
    if depth is None:
        row, column = torch.arange(shape[0])[:, None], torch.arange(shape[1])
        depth = 1.5 + 0.1 * torch.sin(row + 0.5 * column)
    values = torch.arange(depth.numel() * 4.0).view(*shape, 4)
    return FeatureFrame(camera, values, depth, torch.full(shape, alpha))


def low_camera(scale: int) -> Camera:
    """8 x 6 pixels, each s x s of a picture of which the principal point is not the middle."""
    camera = look_at_the_middle(0.1, 0.3)
    full = replace(camera, cx=4.25 * scale, cy=2.5 * scale, width=8 * scale, height=6 * scale)
    return scale_camera(replace(full, fx=9.0 * scale, fy=10.0 * scale), 8, 6)


def shown(cloud: PointCloud, camera: Camera) -> Tensor:
    """The point of `cloud` that each pixel of `camera` shows, -1 for none: [H, W]."""
    pixel = cloud.shown_in(camera).pixel
    index = torch.full((camera.height * camera.width + 1,), -1)
    index[pixel] = torch.arange(len(pixel))
    return index[:-1].view(camera.height, camera.width)


@pytest.mark.parametrize("scale", [1, 2, 3, 4])
def test_a_still_frame_is_shown_in_the_first_pixel_of_each_cell(scale):
    """Off by s / 2 - 1/2 pixels from the middle of the cell."""
    low = low_camera(scale)
    full = scale_camera(low, 8 * scale, 6 * scale)
    cloud = PointCloud.of(frame_of(low))
    index, depth = shown(cloud, full), project(full, cloud.points)[1]
    assert torch.equal(index[::scale, ::scale].flatten(), torch.arange(48))
    assert (index >= 0).sum() == 48
    # Coordinates up to 2 are rounded a dozen times.
    assert_near(depth, frame_of(low).depth.flatten(), atol=24 * 2.0**-24)


def test_a_frame_of_nothing_is_shown_nowhere_else():
    """Its points lie at its camera: behind, or in front of, any other."""
    low = low_camera(2)
    cloud = PointCloud.of(frame_of(low, torch.full((6, 8), math.inf), alpha=0.0))
    assert_near(cloud.points, low.c2w[:, 3].expand(48, 3), atol=1e-11)
    ahead = replace(low, c2w=low.c2w.clone())
    ahead.c2w[:, 3] += 0.1 * low.c2w[:, 2]
    assert (shown(cloud, ahead) == -1).all()
    assert (shown(cloud.expected(), low) == -1).all()


@pytest.mark.parametrize("age", [1, 2])
@pytest.mark.parametrize("which", ["zero_upsampling", "direct"])
def test_features_land_where_the_released_code_puts_them(which, age):
    """`warp_zero_upsampling`, with which it trains, and `warp_direct`, with which it renders. Six
    pixels of one frame are empty: they must write nothing that is seen."""
    given = {name: torch.from_numpy(RELEASE[f"warp.{name}"]) for name in ("poses", "depth")}
    cameras = [Camera(pose[:3], 14.0, 14.0, 6.0, 5.0, 12, 10) for pose in given["poses"]]
    features = np.concatenate((RELEASE["warp.rgb"][age], RELEASE["warp.feat"][age]))
    depth, values = given["depth"][age], torch.from_numpy(features).permute(1, 2, 0)
    seen = depth > 0
    frame = FeatureFrame(cameras[age], values, depth.where(seen, math.inf), seen.float())
    index = shown(PointCloud.of(frame), scale_camera(cameras[0], 48, 40))
    # Features are moved, not computed: no rounding at all.
    wanted = torch.from_numpy(RELEASE[f"warp.{which}"][age]).permute(1, 2, 0)
    assert torch.equal(torch.cat((values.flatten(0, 1), torch.zeros(1, 6)))[index], wanted)


def test_summed_depths_are_too_near_unless_the_opacity_is_divided_out():
    low = low_camera(4)
    frame = frame_of(low)
    frame.alpha[:3] = 0.5
    frame.alpha[3, 2:4] = torch.tensor([RELIABLE_ALPHA, RELIABLE_ALPHA * 1.01])
    frame.depth[5], frame.alpha[5] = math.inf, 0.0
    summed = PointCloud.of(frame)
    _, z = project(low, summed.points)
    _, expected = project(low, summed.expected().points)
    error = 24 * 2 * 2.0**-24
    near = (frame.depth * frame.alpha).flatten()[:40]
    assert_near(z[:40], near, atol=error)
    unclear = torch.zeros(48, dtype=torch.bool)
    unclear[26], unclear[40:] = True, True  # faint, and empty
    assert torch.equal(expected.isnan(), unclear)
    true = frame.depth.flatten()[~unclear]
    assert_near(expected[~unclear], true, atol=10 * error)


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
        how = replace(how, window=interval.view(-1, 2))
    by = everywhere(field, EVERYWHERE, probe, how)
    return render_frame(along_x(), EVERYWHERE, torch.ones(4), probe, by), probe.done["samples"]


def interval_of(frame: FeatureFrame) -> Tensor:
    """Of a camera that stays where it is."""
    return PointCloud.of(frame).expected().interval(along_x(), EPSILON)


def test_a_surface_is_found_inside_the_interval_alone():
    whole, samples = render(Solid(wall(0.3)))
    interval = interval_of(whole)
    assert interval.isfinite().all()
    # Where the surface stayed it is found, all of it, with fewer samples.
    same, fewer = render(Solid(wall(0.3)), interval)
    assert_near(same.values, whole.values, atol=1e-5)
    assert fewer < 0.5 * samples
    # Where it moved, nothing is made up for what is missing.
    moved, _ = render(Solid(wall(0.7)), interval)
    assert not moved.alpha.any()
    assert (moved.values == 1).all()  # the background


def test_the_interval_is_that_of_the_pixel_alone_and_everything_where_nothing_is_known():
    frame, _ = render(Solid(ball()))
    interval = interval_of(frame)
    seen = frame.alpha > RELIABLE_ALPHA
    assert torch.equal(interval[..., 1].isfinite(), seen)
    assert 0 < seen.sum() < SIZE**2
    assert (interval[~seen][:, 0] == 0).all()
    middle = interval[seen].mean(dim=-1)
    assert_near(middle, frame.depth[seen], atol=1e-5)
    width = interval[seen].diff(dim=-1).squeeze(-1)
    assert_near(width, torch.full_like(width, 2 * EPSILON), atol=1e-6)

"""Which rays of a frame are rendered, and what stands in its pixels."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from bench.cameras import cast
from bench.types import EMPTY_ALPHA, NullProbe
from methods.instant_ngp.field import HashField
from methods.kernels.march import march
from methods.kernels.types import Occupancy
from methods.rendering.frame import everywhere, rays_at_matter, render_frame
from methods.rendering.occupancy import STEP
from methods.rendering.rays import render_rays
from methods.rendering.sampling import Sampling
from tests.methods.conftest import Work, look_at_the_middle


@pytest.mark.parametrize(("turn", "lift"), [(0.0, 0.0), (0.13, 0.7), (0.6, -1.2)])
def test_no_ray_that_has_samples_is_left_out(
    cloud: tuple[HashField, Occupancy], turn: float, lift: float
) -> None:
    occupancy = Occupancy(cloud[1].cells.cpu())
    camera = look_at_the_middle(turn, lift)
    pixels, rays = rays_at_matter(camera, occupancy)
    every_ray = cast(camera)
    counts = march(every_ray, occupancy, STEP).offsets.diff()
    left_out = torch.ones(len(counts), dtype=torch.bool)
    left_out[pixels] = False
    assert not counts[left_out].any()
    assert 0 < len(pixels) < len(counts)
    torch.testing.assert_close(rays.directions, every_ray.directions[pixels])


def test_a_camera_inside_the_matter_sees_it_in_all_pixels() -> None:
    camera = look_at_the_middle(0.0, 0.0)
    inside = replace(camera, c2w=camera.c2w.clone())
    inside.c2w[:, 3] = 0.5
    pixels, _ = rays_at_matter(inside, Occupancy(torch.ones(16, 16, 16, dtype=torch.bool)))
    assert len(pixels) == camera.width * camera.height


def test_a_frame_is_its_rays_on_the_background(cloud: tuple[HashField, Occupancy]) -> None:
    field, occupancy = cloud
    camera = look_at_the_middle(0.1, 0.4)
    camera = replace(camera, c2w=camera.c2w.to(field.device), width=20)
    background, work = torch.tensor((0.25, 0.5, 1.0), device=field.device), Work()
    render = everywhere(field, occupancy, work, Sampling())
    frame = render_frame(camera, occupancy, background, work, render)
    assert frame.values.shape == (32, 20, 3)
    pixels = render_rays(field, cast(camera), occupancy, NullProbe(), Sampling())
    # The same rays among others: sums of float32 in another order.
    alpha = pixels.alpha.view(32, 20)
    torch.testing.assert_close(frame.alpha, alpha, rtol=0, atol=1e-6)
    shown = pixels.values.view(32, 20, 3) + (1 - alpha)[..., None] * background
    torch.testing.assert_close(frame.values, shown, rtol=0, atol=1e-6)
    assert torch.equal(frame.depth.isfinite(), frame.alpha > EMPTY_ALPHA)
    assert 0 < frame.depth.isfinite().sum() < 32 * 20
    seen = frame.depth.isfinite()
    depth = pixels.depth_sum.view(32, 20)[seen] / alpha[seen]
    torch.testing.assert_close(frame.depth[seen], depth, rtol=1e-4, atol=0)
    assert work.done["rays"] == len(rays_at_matter(camera, occupancy)[0]) < 32 * 20


def test_a_window_is_that_of_its_pixel(cloud: tuple[HashField, Occupancy]) -> None:
    """Half of the pixels may look nowhere, though `render_frame` asks for some pixels only."""
    field, occupancy = cloud
    camera = look_at_the_middle(0.1, 0.4)
    camera = replace(camera, c2w=camera.c2w.to(field.device))
    window = torch.tensor((0.0, torch.inf), device=field.device).repeat(32, 32, 1)
    window[:, :16] = 0.0
    black, probe = torch.zeros(3, device=field.device), NullProbe()
    whole, half = (
        render_frame(camera, occupancy, black, probe, everywhere(field, occupancy, probe, how))
        for how in (Sampling(), Sampling(window=window.view(-1, 2)))
    )
    assert whole.alpha[:, :16].any()
    assert not half.alpha[:, :16].any()
    torch.testing.assert_close(half.alpha[:, 16:], whole.alpha[:, 16:], rtol=0, atol=1e-6)

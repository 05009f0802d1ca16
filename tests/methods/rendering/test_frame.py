"""Which rays of a frame are rendered, how, and what its pixels hold."""

from dataclasses import replace

import pytest
import torch

from bench.cameras import cast, place_camera
from bench.types import EMPTY_ALPHA, NullProbe
from methods.instant_ngp.field import HashField
from methods.kernels.march import march
from methods.kernels.types import Occupancy
from methods.rendering import frame as rendering
from methods.rendering.frame import everywhere, rays_at_matter, render_frame, render_rays
from methods.rendering.occupancy import STEP
from methods.rendering.sampling import FAINT, Sampling
from tests.common import assert_near, seeded
from tests.methods.conftest import GRID, Work, look_at_the_middle
from tests.methods.rendering.test_batch import rays_on
from tests.methods.solids import Solid, wall


@pytest.mark.parametrize(("turn", "lift"), [(0.0, 0.0), (0.13, 0.7), (0.6, -1.2)])
def test_no_ray_that_has_samples_is_left_out(cloud, turn, lift):
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


def test_a_camera_inside_the_matter_sees_it_in_all_pixels():
    camera = look_at_the_middle(0.0, 0.0)
    inside = replace(camera, c2w=camera.c2w.clone())
    inside.c2w[:, 3] = 0.5
    pixels, _ = rays_at_matter(inside, Occupancy(torch.ones(16, 16, 16, dtype=torch.bool)))
    assert len(pixels) == camera.width * camera.height


def test_a_frame_is_its_rays_on_the_background(cloud):
    field, occupancy = cloud
    camera = replace(place_camera(look_at_the_middle(0.1, 0.4), field.device), width=20)
    background, work = torch.tensor((0.25, 0.5, 1.0), device=field.device), Work()
    render = everywhere(field, occupancy, work, Sampling())
    frame = render_frame(camera, occupancy, background, work, render)
    assert frame.values.shape == (32, 20, 3)
    pixels = render_rays(field, cast(camera), occupancy, NullProbe(), Sampling())
    # The same rays among others: sums of float32 in another order.
    alpha = pixels.alpha.view(32, 20)
    assert_near(frame.alpha, alpha, atol=1e-6)
    shown = pixels.values.view(32, 20, 3) + (1 - alpha)[..., None] * background
    assert_near(frame.values, shown, atol=1e-6)
    assert torch.equal(frame.depth.isfinite(), frame.alpha > EMPTY_ALPHA)
    assert 0 < frame.depth.isfinite().sum() < 32 * 20
    seen = frame.depth.isfinite()
    depth = pixels.depth_sum.view(32, 20)[seen] / alpha[seen]
    torch.testing.assert_close(frame.depth[seen], depth, rtol=1e-4, atol=0)
    assert work.done["rays"] == len(rays_at_matter(camera, occupancy)[0]) < 32 * 20


def test_a_window_is_that_of_its_pixel(cloud):
    """Half of the pixels may look nowhere, though `render_frame` asks for some pixels only."""
    field, occupancy = cloud
    camera = place_camera(look_at_the_middle(0.1, 0.4), field.device)
    window = torch.tensor((0.0, torch.inf), device=field.device).repeat(32, 32, 1)
    window[:, :16] = 0.0
    black, probe = torch.zeros(3, device=field.device), NullProbe()
    whole, half = (
        render_frame(camera, occupancy, black, probe, everywhere(field, occupancy, probe, how))
        for how in (Sampling(), Sampling(window=window.view(-1, 2)))
    )
    assert whole.alpha[:, :16].any()
    assert not half.alpha[:, :16].any()
    assert_near(half.alpha[:, 16:], whole.alpha[:, 16:], atol=1e-6)


def test_at_once_rays_look_as_in_rounds(cloud, device, monkeypatch):
    field, occupancy = cloud
    rays = rays_on(device)
    window = torch.tensor((0.0, 1.7), device=device).expand(len(rays.origins), 2)
    found = []
    for compacts, chunk in ((True, 10_000), (True, 100), (False, 10_000), (False, 100)):
        monkeypatch.setattr(rendering, "compacts", lambda device, compacts=compacts: compacts)
        monkeypatch.setattr(rendering, "CHUNK_RAYS", chunk)
        found.append(render_rays(field, rays, occupancy, NullProbe(), Sampling(window=window)))
    rounds, rounds_of_chunks, once, chunks = found
    assert 0.2 < rounds.alpha.max() < 1
    for name in ("values", "depth_sum", "alpha"):
        # All end a ray at the same transmittance; sums are added up in another grouping, as a chunk
        # has rounds of its own.
        a, b, c, d = (getattr(x, name) for x in (rounds, rounds_of_chunks, once, chunks))
        assert_near(a, b, atol=3e-4)
        assert_near(a, c, atol=3e-4)
        assert_near(c, d, atol=1e-6)


def test_samples_behind_the_early_stop_are_hardly_evaluated():
    field = Solid(wall(0.0), density=1e5)
    occupancy = Occupancy(torch.ones(32, 32, 32, dtype=torch.bool))
    rays, work = cast(look_at_the_middle(0.0, 0.0)), Work()
    pixels = render_rays(field, rays, occupancy, work, Sampling())
    hit = int((pixels.alpha > 0).sum())
    assert hit > 0
    assert work.done["samples"] <= field.round_samples * hit  # one round for each ray that hits


@pytest.mark.parametrize("compacts", [True, False])
def test_faint_samples_are_black_and_not_looked_at_in_rounds(cloud, compacts, monkeypatch):
    monkeypatch.setattr(rendering, "compacts", lambda device: compacts)
    field, occupancy = cloud
    rays = rays_on(field.device)
    stop, work = 0.01, Work()
    rendered = render_rays(field, rays, occupancy, work, Sampling(stop=stop))
    assert work.done["shaded_samples"] > 0
    assert (work.done["shaded_samples"] < work.done["samples"]) == compacts
    # Of a field whose features are 1 everywhere, what is shown is the sum of the weights seen.
    field.features = lambda geometry, directions: torch.ones(
        len(geometry), field.channels, device=geometry.device
    )
    seen = render_rays(field, rays, occupancy, NullProbe(), Sampling(stop=stop))
    assert_near(seen.alpha, rendered.alpha, atol=0)
    missing = seen.alpha - seen.values[:, 0]
    samples = march(rays, occupancy, STEP).offsets.diff()
    assert missing.min() > -1e-5
    assert (missing <= samples * FAINT * stop + 1e-5).all()
    assert missing.max() > 0


@pytest.mark.parametrize("compacts", [True, False])
def test_an_empty_grid_renders_nothing(compacts, monkeypatch):
    monkeypatch.setattr(rendering, "compacts", lambda device: compacts)
    field = HashField(GRID, generator=seeded(0))
    occupancy = Occupancy(torch.zeros(16, 16, 16, dtype=torch.bool))
    camera = look_at_the_middle(0.0, 0.0)
    rendered = render_rays(field, cast(camera), occupancy, NullProbe(), Sampling())
    assert len(rendered.alpha) == camera.width * camera.height
    assert not rendered.alpha.any()

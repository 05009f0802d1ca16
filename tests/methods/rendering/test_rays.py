"""Rendering rays in rounds."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from bench.cameras import cast, place_camera
from bench.types import NullProbe
from methods.instant_ngp.field import HashField
from methods.kernels.march import march
from methods.kernels.types import Occupancy
from methods.rendering import rays as rendering
from methods.rendering.batch import render_batch
from methods.rendering.occupancy import STEP
from methods.rendering.rays import CHUNK_RAYS, render_rays
from methods.rendering.sampling import FAINT, Sampling
from tests.methods.conftest import GRID, Work, look_at_the_middle


def test_rounds_render_what_one_go_renders(cloud: tuple[HashField, Occupancy], device: str) -> None:
    field, occupancy = cloud
    camera = look_at_the_middle(0.1, 0.4)
    rays = cast(replace(camera, c2w=camera.c2w.to(device)))
    half = torch.full((len(rays.origins),), 0.5, device=device)
    with torch.no_grad():
        whole, _ = render_batch(field, rays, occupancy, Sampling(), jitter=half)
    rounds = render_rays(field, rays, occupancy, NullProbe(), Sampling())
    assert whole.alpha.max() > 0.5
    # Both end a ray at the same transmittance; sums are added up in another grouping.
    torch.testing.assert_close(rounds.values, whole.values, rtol=0, atol=1e-4)
    torch.testing.assert_close(rounds.depth_sum, whole.depth_sum, rtol=0, atol=3e-4)
    torch.testing.assert_close(rounds.alpha, whole.alpha, rtol=0, atol=1e-4)


def test_at_once_rays_look_as_in_rounds(
    cloud: tuple[HashField, Occupancy], device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    field, occupancy = cloud
    rays = cast(place_camera(look_at_the_middle(0.1, 0.4), device))
    window = torch.tensor((0.0, 1.7), device=device).expand(len(rays.origins), 2)
    found = []
    for compacts, chunk in ((True, CHUNK_RAYS), (False, CHUNK_RAYS), (False, 100)):
        monkeypatch.setattr(rendering, "compacts", lambda device, compacts=compacts: compacts)
        monkeypatch.setattr(rendering, "CHUNK_RAYS", chunk)
        found.append(render_rays(field, rays, occupancy, NullProbe(), Sampling(window=window)))
    rounds, once, chunks = found
    assert 0.2 < rounds.alpha.max() < 1
    for name in ("values", "depth_sum", "alpha"):
        # As in `test_rounds_render_what_one_go_renders`.
        a, b, c = (getattr(pixels, name) for pixels in (rounds, once, chunks))
        torch.testing.assert_close(a, b, rtol=0, atol=3e-4)
        torch.testing.assert_close(b, c, rtol=0, atol=1e-6)


def test_samples_behind_the_early_stop_are_hardly_evaluated() -> None:
    field = HashField(GRID, precision="fp32", generator=torch.Generator().manual_seed(0))
    field.density = lambda positions: (  # type: ignore[method-assign]
        torch.full((len(positions),), 1e5),
        torch.zeros(len(positions), 16),
    )
    occupancy = Occupancy(torch.ones(32, 32, 32, dtype=torch.bool))
    rays, work = cast(look_at_the_middle(0.0, 0.0)), Work()
    pixels = render_rays(field, rays, occupancy, work, Sampling())
    hit = int((pixels.alpha > 0).sum())
    assert hit > 0
    assert work.done["samples"] <= field.round_samples * hit  # one round for each ray that hits


@pytest.mark.parametrize("compacts", [True, False])
def test_faint_samples_are_black_and_not_looked_at_in_rounds(
    cloud: tuple[HashField, Occupancy], compacts: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rendering, "compacts", lambda device: compacts)
    field, occupancy = cloud
    camera = look_at_the_middle(0.1, 0.4)
    rays = cast(replace(camera, c2w=camera.c2w.to(field.device)))
    stop, work = 0.01, Work()
    rendered = render_rays(field, rays, occupancy, work, Sampling(stop=stop))
    assert work.done["shaded_samples"] > 0
    assert (work.done["shaded_samples"] < work.done["samples"]) == compacts
    # Of a field whose features are 1 everywhere, what is shown is the sum of the weights seen.
    field.features = lambda geometry, directions: torch.ones(  # type: ignore[method-assign]
        len(geometry), field.channels, device=geometry.device
    )
    seen = render_rays(field, rays, occupancy, NullProbe(), Sampling(stop=stop))
    torch.testing.assert_close(seen.alpha, rendered.alpha, rtol=0, atol=0)
    missing = seen.alpha - seen.values[:, 0]
    samples = march(rays, occupancy, STEP).offsets.diff()
    assert missing.min() > -1e-5
    assert (missing <= samples * FAINT * stop + 1e-5).all()
    assert missing.max() > 0


@pytest.mark.parametrize("compacts", [True, False])
def test_an_empty_grid_renders_nothing(compacts: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rendering, "compacts", lambda device: compacts)
    field = HashField(GRID, generator=torch.Generator().manual_seed(0))
    occupancy = Occupancy(torch.zeros(16, 16, 16, dtype=torch.bool))
    camera = look_at_the_middle(0.0, 0.0)
    rendered = render_rays(field, cast(camera), occupancy, NullProbe(), Sampling())
    assert len(rendered.alpha) == camera.width * camera.height
    assert not rendered.alpha.any()


def test_rays_go_on_behind_what_they_carry(cloud: tuple[HashField, Occupancy]) -> None:
    """In two windows, one behind the other, they see what they see in one go."""
    field, occupancy = cloud
    camera = look_at_the_middle(0.1, 0.4)
    rays = cast(replace(camera, c2w=camera.c2w.to(field.device)))
    near = torch.zeros(len(rays.origins), 2, device=field.device)
    near[:, 1] = 1.6  # half of the way through the box
    far = torch.stack((near[:, 1], torch.full_like(near[:, 1], torch.inf)), dim=1)
    whole = render_rays(field, rays, occupancy, NullProbe(), Sampling())
    front = render_rays(field, rays, occupancy, NullProbe(), Sampling().within(near))
    assert 0 < front.alpha.sum() < 0.95 * whole.alpha.sum()
    both = render_rays(field, rays, occupancy, NullProbe(), Sampling().within(far), front)
    assert both is front
    # A sample on the border may be in both or in neither of the windows: a share of 1 / 1000 of
    # the cube.
    torch.testing.assert_close(both.alpha, whole.alpha, rtol=0, atol=0.02)


def test_a_weight_is_faint_below_a_share_of_the_transmittance_at_the_end() -> None:
    assert Sampling(stop=0.01).least_weight == FAINT * 0.01
    assert Sampling(stop=0.01, faint=0.25).least_weight == 0.25

"""Rendering rays all at once and in rounds."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from bench.cameras import cast
from bench.types import NullProbe
from methods.fields import HashField
from methods.kernels.composite import composite
from methods.kernels.encode import HashGrid
from methods.kernels.march import Occupancy, march
from methods.occupancy import STEP
from methods.volume import ROUND_SAMPLES, rays_at_matter, render_batch, render_rays
from tests.methods.conftest import look_at_the_middle

GRID = HashGrid(levels=4, log2_table=10, n_min=4, n_max=32)


@pytest.fixture
def cloud(device: str) -> tuple[HashField, Occupancy]:
    """A random field, dense enough to stop rays, in a box of the cube."""
    field = HashField(GRID, precision="fp32", generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        field.table.mul_(3e4)
    cells = torch.zeros(32, 32, 32, dtype=torch.bool, device=device)
    cells[8:20, 4:28, 10:22] = True
    return field.to(device), Occupancy(cells)


def test_rounds_render_what_one_go_renders(cloud: tuple[HashField, Occupancy], device: str) -> None:
    field, occupancy = cloud
    camera = look_at_the_middle(0.1, 0.4)
    rays = cast(replace(camera, c2w=camera.c2w.to(device)))
    half = torch.full((len(rays.origins),), 0.5, device=device)
    with torch.no_grad():
        whole, _ = render_batch(field, rays, occupancy, half, torch.zeros(3, device=device))
    rounds = render_rays(field, rays, occupancy, NullProbe())
    assert whole.alpha.max() > 0.5
    # Both end a ray at the same transmittance; sums are added up in another grouping.
    torch.testing.assert_close(rounds.values, whole.values, rtol=0, atol=1e-4)
    torch.testing.assert_close(rounds.depth_sum, whole.depth_sum, rtol=0, atol=3e-4)
    torch.testing.assert_close(rounds.alpha, whole.alpha, rtol=0, atol=1e-4)


def test_leaving_out_hidden_samples_changes_no_gradient(
    cloud: tuple[HashField, Occupancy], device: str
) -> None:
    field, occupancy = cloud
    thin = field.density
    field.density = lambda x: (100 * thin(x)[0], thin(x)[1])  # type: ignore[method-assign]
    camera = look_at_the_middle(0.1, 0.4)
    rays = cast(replace(camera, c2w=camera.c2w.to(device)))
    jitter = torch.rand(len(rays.origins), generator=torch.Generator().manual_seed(0)).to(device)
    white = torch.ones(3, device=device)

    pixels, used = render_batch(field, rays, occupancy, jitter, white)
    pixels.values.square().sum().backward()
    grads = [p.grad.clone() for p in field.parameters() if p.grad is not None]
    field.zero_grad()

    samples = march(rays.origins, rays.directions, occupancy, STEP, jitter=jitter)
    sigma, geometry = field.density(samples.positions)
    values = field.features(geometry, field.encode_directions(rays.directions)[samples.ray])
    whole = composite(sigma, values, samples.t, samples.delta, samples.offsets, background=white)
    whole.values.square().sum().backward()

    assert used < 0.9 * len(samples)
    assert len(grads) == 6
    for got, want in zip(grads, (p.grad for p in field.parameters()), strict=True):
        assert want is not None
        # Sums over up to 10^5 samples, in another grouping.
        torch.testing.assert_close(got, want, rtol=1e-3, atol=1e-4 * want.abs().max().item())


def test_samples_behind_the_early_stop_are_hardly_evaluated() -> None:
    field = HashField(GRID, precision="fp32", generator=torch.Generator().manual_seed(0))
    field.density = lambda positions: (  # type: ignore[method-assign]
        torch.full((len(positions),), 1e5),
        torch.zeros(len(positions), 16),
    )
    occupancy = Occupancy(torch.ones(32, 32, 32, dtype=torch.bool))
    evaluated = 0

    class Counter(NullProbe):
        def count(self, name: str, done: int, dense: int | None = None) -> None:
            nonlocal evaluated
            evaluated += done if name == "samples" else 0

    rays = cast(look_at_the_middle(0.0, 0.0))
    pixels = render_rays(field, rays, occupancy, Counter())
    hit = int((pixels.alpha > 0).sum())
    assert hit > 0
    assert evaluated <= ROUND_SAMPLES * hit  # one round for each ray that hits


@pytest.mark.parametrize(("turn", "lift"), [(0.0, 0.0), (0.13, 0.7), (0.6, -1.2)])
def test_no_ray_that_has_samples_is_left_out(
    cloud: tuple[HashField, Occupancy], turn: float, lift: float
) -> None:
    occupancy = Occupancy(cloud[1].cells.cpu())
    camera = look_at_the_middle(turn, lift)
    pixels, rays = rays_at_matter(camera, occupancy)
    everywhere = cast(camera)
    counts = march(everywhere.origins, everywhere.directions, occupancy, STEP).offsets.diff()
    left_out = torch.ones(len(counts), dtype=torch.bool)
    left_out[pixels] = False
    assert not counts[left_out].any()
    assert 0 < len(pixels) < len(counts)
    torch.testing.assert_close(rays.directions, everywhere.directions[pixels])


def test_a_camera_inside_the_matter_sees_it_in_all_pixels() -> None:
    camera = look_at_the_middle(0.0, 0.0)
    inside = replace(camera, c2w=camera.c2w.clone())
    inside.c2w[:, 3] = 0.5
    pixels, _ = rays_at_matter(inside, Occupancy(torch.ones(16, 16, 16, dtype=torch.bool)))
    assert len(pixels) == camera.width * camera.height


def test_an_empty_grid_renders_nothing() -> None:
    field = HashField(GRID, generator=torch.Generator().manual_seed(0))
    occupancy = Occupancy(torch.zeros(16, 16, 16, dtype=torch.bool))
    pixels, rays = rays_at_matter(look_at_the_middle(0.0, 0.0), occupancy)
    rendered = render_rays(field, rays, occupancy, NullProbe())
    assert not rendered.alpha.any()
    assert len(pixels) == len(rendered.alpha)

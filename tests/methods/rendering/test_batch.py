"""Rendering rays all at once."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from bench.cameras import cast
from methods.instant_ngp.field import HashField
from methods.kernels.composite import composite
from methods.kernels.march import Occupancy, march
from methods.rendering.batch import rays_at_matter, render_batch
from methods.rendering.occupancy import STEP
from tests.methods.conftest import look_at_the_middle


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

    samples = march(rays, occupancy, STEP, jitter=jitter)
    sigma, geometry = field.density(samples.positions)
    values = field.features(geometry, field.encode_directions(rays.directions)[samples.ray])
    whole = composite(sigma, values, samples).over(white)
    whole.values.square().sum().backward()

    assert used < 0.9 * len(samples)
    assert len(grads) == 6
    for got, want in zip(grads, (p.grad for p in field.parameters()), strict=True):
        assert want is not None
        # Sums over up to 10^5 samples, in another grouping.
        torch.testing.assert_close(got, want, rtol=1e-3, atol=1e-4 * want.abs().max().item())


@pytest.mark.parametrize(("turn", "lift"), [(0.0, 0.0), (0.13, 0.7), (0.6, -1.2)])
def test_no_ray_that_has_samples_is_left_out(
    cloud: tuple[HashField, Occupancy], turn: float, lift: float
) -> None:
    occupancy = Occupancy(cloud[1].cells.cpu())
    camera = look_at_the_middle(turn, lift)
    pixels, rays = rays_at_matter(camera, occupancy)
    everywhere = cast(camera)
    counts = march(everywhere, occupancy, STEP).offsets.diff()
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

"""Overlapping media: the piecewise integral against closed forms and brute-force quadrature."""

from __future__ import annotations

import math

import pytest
import torch

from bench.cameras import cast
from bench.scenes.models import cloud
from bench.scenes.raytrace import Ball, Cloud, render
from bench.types import Camera
from tests.bench.scenes.conftest import camera_at

BLACK = torch.zeros(3)


@pytest.mark.parametrize("density", [0.01, 1.0, 30.0])
def test_one_ball_through_its_middle(device, density) -> None:
    model = Cloud([Ball((0.0, 0.0, 0.0), 0.5, density, (0.8, 0.4, 0.2))])
    frame = render(model, camera_at((0.0, -4.0, 0.0), 1, device), BLACK, samples=1)
    alpha = 1 - math.exp(-density)
    # Mean of an exponential of rate k cut off at 1: 1 / k - 1 / (e^k - 1), from t = 3.5 on.
    depth = 3.5 + 1 / density - 1 / math.expm1(density)
    assert frame.alpha.item() == pytest.approx(alpha, rel=1e-5)
    assert frame.depth.item() == pytest.approx(depth, rel=2e-5)
    assert frame.rgb.flatten().tolist() == pytest.approx(
        [0.8 * alpha, 0.4 * alpha, 0.2 * alpha], rel=1e-5
    )


def quadrature(model: Cloud, camera: Camera, steps: int) -> tuple[torch.Tensor, ...]:
    """rgb, alpha, and depth times alpha of the pixel centres, by the midpoint rule on [0, 6]."""
    rays = cast(camera)
    width = 6 / steps
    t = (torch.arange(steps, dtype=torch.float64) + 0.5) * width
    points = rays.origins.double()[:, None] + t[:, None] * rays.directions.double()[:, None]
    sigma = torch.zeros(points.shape[:2], dtype=torch.float64)
    glow = torch.zeros_like(points)
    for ball in model.balls:
        inside = (points - torch.tensor(ball.centre)).norm(dim=-1) < ball.radius
        sigma += ball.density * inside
        glow += ball.density * inside[..., None] * torch.tensor(ball.colour)
    thickness = sigma * width * rays.directions.double().norm(dim=1, keepdim=True)
    passed = torch.exp(-thickness.cumsum(1))  # after each step
    weight = passed * torch.expm1(thickness)
    colour = glow / sigma.clamp(min=1e-12)[..., None]
    return (weight[..., None] * colour).sum(1), 1 - passed[:, -1], (weight * t).sum(1)


@pytest.mark.parametrize("eye", [(0.5, -3.0, 1.0), (0.1, 0.0, -0.4)], ids=["outside", "inside"])
def test_overlapping_balls_against_quadrature(eye) -> None:
    camera = camera_at(eye, 12)
    frame = render(cloud(), camera, BLACK, samples=1)
    rgb, alpha, depth = quadrature(cloud(), camera, steps=6000)
    # A step that a surface cuts is wrong by its optical thickness at most, k h |d|: surfaces come
    # in pairs, densities sum to 70.
    error = 2 * 70 * (6 / 6000) * 1.2 / 2
    assert (frame.alpha.flatten() - alpha).abs().max() <= error
    assert (frame.rgb.reshape(-1, 3) - rgb).abs().max() <= error
    seen = alpha > 0.05
    got = (frame.depth * frame.alpha).flatten()[seen]
    assert (got - depth[seen]).abs().max() <= 4 * error
    # And on average far closer, for errors at the surfaces have both signs.
    assert (frame.alpha.flatten() - alpha).abs().mean() <= error / 20


def test_a_ball_cut_into_two_halves_of_its_density_is_the_same() -> None:
    whole = Cloud([Ball((0.1, 0.0, 0.0), 0.6, 3.0, (0.9, 0.5, 0.1))])
    halves = Cloud([Ball((0.1, 0.0, 0.0), 0.6, 1.5, (0.9, 0.5, 0.1))] * 2)
    camera = camera_at((0.5, -3.0, 1.0), 16)
    one, two = render(whole, camera, BLACK, 4), render(halves, camera, BLACK, 4)
    torch.testing.assert_close(one.rgb, two.rgb, rtol=0, atol=2e-6)
    torch.testing.assert_close(one.depth, two.depth, rtol=1e-5, atol=0)


def test_a_ball_behind_the_camera_is_not_seen() -> None:
    model = Cloud([Ball((0.0, -6.0, 0.0), 0.5, 9.0, (1.0, 1.0, 1.0))])
    frame = render(model, camera_at((0.0, -4.0, 0.0), 8), BLACK, samples=4)
    assert (frame.alpha == 0).all()

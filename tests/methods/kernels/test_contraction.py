"""Tests of the contraction of space and of the steps of a ray through it."""

import math

import torch
from torch.nn.functional import normalize

from bench.types import Rays
from methods.kernels.composite import composite
from methods.kernels.march import march
from methods.kernels.march.contraction import HALF, contract, expand, stretch
from methods.kernels.types import Occupancy
from tests.common import assert_near, seeded

STEP = math.sqrt(3) / 1024
FULL = Occupancy(torch.ones(16, 16, 16), contracted=True)


def some_points(count=1000):
    generator = seeded(0)
    away = 10 ** (6 * torch.rand(count, 1, generator=generator) - 3)
    return 0.5 + away * normalize(torch.randn(count, 3, generator=generator), dim=1)


def test_points_in_the_box_stay_and_all_others_go_to_the_rest_of_the_cube():
    points = some_points()
    inside = (points - 0.5).abs().amax(dim=1) <= HALF
    places = contract(points)
    assert_near(places[inside], points[inside], atol=1e-7)
    size = (places - 0.5).abs().amax(dim=1)
    assert (size[~inside] >= HALF).all()
    assert (size <= 0.5).all()
    # At n half sides, 2 - 1/n: at 2, 3/2; at 4, 7/4; with the other components in proportion.
    given = torch.tensor([[1.0, 0.5, 0.5], [0.5, -0.5, 0.0]])
    want = torch.tensor([[0.875, 0.5, 0.5], [0.5, 0.5 - 7 / 16, 0.5 - 7 / 32]])
    torch.testing.assert_close(contract(given), want)


def test_expand_inverts_contract_and_stretch_is_its_slope_along_an_axis():
    points = some_points()
    near = points[(points - 0.5).abs().amax(dim=1) < 25]  # 2 - 1/n holds n to 2 n u of itself
    torch.testing.assert_close(expand(contract(near)), near, rtol=1e-4, atol=1e-6)
    away = torch.tensor([0.1, 0.2, 0.3, 1.0, 10.0, 100.0], dtype=torch.float64)
    axis = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    here, there = (contract(0.5 + way[:, None] * axis) for way in (away, away * (1 + 1e-6)))
    slope = 1e-6 * away / (there - here).norm(dim=1)
    torch.testing.assert_close(stretch(here), slope, rtol=1e-5, atol=0)


def test_a_ray_goes_to_infinity_in_few_steps_whose_lengths_add_up(backend):
    generator = seeded(0)
    origins = 0.5 + torch.randn(200, 3, generator=generator)  # in the box, near it and far off
    rays = Rays(origins, torch.randn(200, 3, generator=generator))
    samples = march(rays, FULL, STEP, backend=backend)
    counts = samples.offsets.diff()
    assert (counts <= 1 / STEP).all()
    assert (samples.positions >= 0).all()
    assert (samples.positions <= 1).all()
    lengths = rays.directions.norm(dim=1)
    for ray, (first, end) in enumerate(zip(samples.offsets, samples.offsets[1:], strict=False)):
        t, delta = samples.t[first:end], samples.delta[first:end].double()
        assert t[-1] * lengths[ray] > 24  # r is at least 1 / (1.5 h): 98 half sides
        # Up to the middle of a step. A step at v, of width h, is (h / (2 - v))^2 / 4 of itself too
        # short by the midpoint rule: below 1e-3 up to 2 - v of 15 h.
        way = delta.cumsum(0) - delta / 2
        known = t * lengths[ray] < 2
        torch.testing.assert_close(
            way[known], (t[known] * lengths[ray]).double(), rtol=2e-3, atol=2 * STEP
        )


def test_a_wall_beyond_the_box_is_seen_at_its_depth_whatever_it_hides():
    wall = 3.0  # x from which on everything is solid: 10 half sides from the middle
    targets = torch.rand(100, 3, generator=seeded(0)) - 0.5
    directions = torch.cat((torch.ones(100, 1), targets[:, 1:]), dim=1)
    rays = Rays(torch.full((100, 3), 0.5), directions)  # t is the way along x
    samples = march(rays, FULL, STEP, backend="reference")
    inside = expand(samples.positions.double())[:, 0] > wall
    sigma = torch.where(inside, 1e9, 0.0)
    pixels = composite(sigma, sigma[:, None], samples, stop=1e-4)
    step = STEP * (wall / HALF) ** 2 * 3  # b is up to 0.6 half sides farther than the axis
    torch.testing.assert_close(pixels.alpha, torch.ones(100))
    assert_near(pixels.depth_sum, torch.full((100,), wall - 0.5), atol=step)

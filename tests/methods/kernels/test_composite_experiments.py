"""The exact answers of the quadrature experiments against closed forms and scipy; the errors that
the compositing weights predict."""

from __future__ import annotations

import math

import pytest
import torch
from scipy import integrate

from bench.case import U32
from methods.kernels.composite.experiments import (
    CUT,
    HOMOGENEOUS,
    INSIDE,
    RAMP,
    SLAB,
    Medium,
    render,
)

HEIGHTS = torch.tensor([0.0, 0.3, 1.0], dtype=torch.float64)
MEDIA = pytest.mark.parametrize(
    "medium", [HOMOGENEOUS, RAMP, INSIDE, CUT, SLAB], ids=lambda medium: medium.name
)


def density(medium: Medium, x: float, y: float) -> float:
    return medium.sigma(*(torch.tensor([at], dtype=torch.float64) for at in (x, y))).item()


@MEDIA
def test_the_thickness_is_the_integral_of_the_density(medium):
    for y in HEIGHTS.tolist():
        for x in (0.2, 0.65, 1.0):
            edges = [0.3 + 0.1 * y, 0.7]  # of the slab
            want, _ = integrate.quad(lambda s, y=y: density(medium, s, y), 0, x, points=edges)
            at = torch.tensor([x], dtype=torch.float64), torch.tensor([y], dtype=torch.float64)
            assert medium.thickness(*at).item() == pytest.approx(want, rel=1e-9, abs=1e-12)


@MEDIA
def test_opacity_and_depth_are_those_of_the_rendering_integral(medium):
    def weight(x: float, y: float) -> float:
        at = torch.tensor([x], dtype=torch.float64), torch.tensor([y], dtype=torch.float64)
        return density(medium, x, y) * math.exp(-medium.thickness(*at).item())

    quantities = {"alpha": 0} if medium is SLAB else {"alpha": 0, "depth_sum": 1}
    for quantity, power in quantities.items():
        exact = medium.exact(quantity, HEIGHTS)
        for y, got in zip(HEIGHTS.tolist(), exact.tolist(), strict=True):
            edges = [0.3 + 0.1 * y, 0.7]
            want, _ = integrate.quad(
                lambda x, y=y, power=power: x**power * weight(x, y), 0, 1, points=edges
            )
            assert got == pytest.approx(want, rel=1e-9)


def test_the_depth_of_a_homogeneous_medium_is_the_closed_form():
    sigma = HOMOGENEOUS.sigma(HEIGHTS, HEIGHTS)
    want = 1 / sigma - torch.exp(-sigma) * (1 + 1 / sigma)
    torch.testing.assert_close(HOMOGENEOUS.exact("depth_sum", HEIGHTS), want, rtol=1e-13, atol=0)


def test_the_depth_of_a_ramp_is_the_closed_form():
    slope = RAMP.sigma(torch.ones_like(HEIGHTS), HEIGHTS)
    root = (slope / 2).sqrt()
    want = math.sqrt(math.pi) / 2 * torch.erf(root) / root - torch.exp(-slope / 2)
    torch.testing.assert_close(RAMP.exact("depth_sum", HEIGHTS), want, rtol=1e-13, atol=0)


@pytest.mark.parametrize("medium", [HOMOGENEOUS, RAMP], ids=lambda medium: medium.name)
@pytest.mark.parametrize("step", [1 / 4, 1 / 32])
def test_the_weights_make_no_error_in_opacity_where_the_density_is_linear(medium, step):
    y = HEIGHTS.float()
    got = render(medium, "alpha", y, step, 0.5).double()
    # A sum of 1 / step weights, each of a product of as many exponentials of thicknesses up to 8.
    tolerance = 8 * (1 / step + 8) * U32
    torch.testing.assert_close(got, medium.exact("alpha", HEIGHTS), rtol=0, atol=tolerance)


def test_the_depth_of_a_homogeneous_medium_is_too_far_by_what_the_weights_predict():
    """By (x coth x - 1) alpha / sigma with x = sigma delta / 2: about delta^2 sigma alpha / 12.

    More light ends in the first half of an interval than in the second, and the sample between
    them stands for both.
    """
    step, y = 1 / 16, HEIGHTS.float()
    sigma = HOMOGENEOUS.sigma(HEIGHTS, HEIGHTS)
    half = sigma * step / 2
    alpha = HOMOGENEOUS.exact("alpha", HEIGHTS)
    want = (half / torch.tanh(half) - 1) * alpha / sigma
    got = render(HOMOGENEOUS, "depth_sum", y, step, 0.5) - HOMOGENEOUS.exact("depth_sum", HEIGHTS)
    torch.testing.assert_close(got, want, rtol=0, atol=8 * (1 / step + 8) * U32)
    torch.testing.assert_close(want, step**2 * sigma * alpha / 12, rtol=0.01, atol=0)

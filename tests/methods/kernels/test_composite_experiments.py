"""The exact answers of the quadrature experiments against scipy."""

from __future__ import annotations

import math

import pytest
import torch
from scipy import integrate

from methods.kernels.composite.experiments import density, exact, thickness

HEIGHTS = [0.0, 0.3, 1.0]


def at(function, x: float, y: float) -> float:
    return function(*(torch.tensor([place], dtype=torch.float64) for place in (x, y))).item()


@pytest.mark.parametrize("y", HEIGHTS)
def test_the_thickness_is_the_integral_of_the_density(y):
    for x in (0.2, 0.65, 1.0):
        want, _ = integrate.quad(lambda s: at(density, s, y), 0, x)
        assert at(thickness, x, y) == pytest.approx(want, rel=1e-9, abs=1e-12)


@pytest.mark.parametrize(("quantity", "power"), [("alpha", 0), ("depth_sum", 1)])
def test_opacity_and_depth_are_those_of_the_rendering_integral(quantity, power):
    answers = exact(quantity, torch.tensor(HEIGHTS, dtype=torch.float64)).tolist()
    for y, got in zip(HEIGHTS, answers, strict=True):
        want, _ = integrate.quad(
            lambda x, y=y: x**power * at(density, x, y) * math.exp(-at(thickness, x, y)), 0, 1
        )
        assert got == pytest.approx(want, rel=1e-9)

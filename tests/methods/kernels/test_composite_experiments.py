"""The exact answers of the quadrature experiments against scipy."""

from __future__ import annotations

import math

import pytest
import torch
from scipy import integrate

from methods.kernels.composite.experiments import exact, slope


@pytest.mark.parametrize(("quantity", "power"), [("alpha", 0), ("depth_sum", 1)])
@pytest.mark.parametrize("y", [0.0, 0.3, 1.0])
def test_opacity_and_depth_are_those_of_the_rendering_integral(quantity, power, y):
    y = torch.tensor(y, dtype=torch.float64)
    s = slope(y).item()
    want, _ = integrate.quad(lambda x: x**power * s * x * math.exp(-s * x * x / 2), 0, 1)
    assert exact(quantity, y).item() == pytest.approx(want, rel=1e-9)

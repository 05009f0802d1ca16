"""The exact answers of the quadrature experiments against scipy."""

from __future__ import annotations

import math

import pytest
import torch
from scipy import integrate

from methods.kernels.composite.experiments import GAUSSIAN, SLAB, Medium

HEIGHTS = torch.tensor([0.0, 0.3, 1.0], dtype=torch.float64)
MEDIA = pytest.mark.parametrize("medium", [GAUSSIAN, SLAB], ids=lambda medium: medium.name)


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

"""Spherical harmonics are those of scipy: orthonormal, of their degree, in their order."""

import numpy as np
import torch
from scipy.special import sph_harm_y
from torch.nn.functional import normalize

from methods.kernels.spherical import CHANNELS, spherical_harmonics
from tests.common import seeded


def with_phase(directions: torch.Tensor, degrees: int) -> np.ndarray:
    """The real harmonics of all degrees below `degrees` in float64, [N, degrees^2], with the
    Condon-Shortley phase."""
    x, y, z = directions.double().T.numpy()
    found = []
    for degree in range(degrees):
        for order in range(-degree, degree + 1):
            value = sph_harm_y(degree, abs(order), np.arccos(z), np.arctan2(y, x))
            part = value.imag if order < 0 else value.real
            found.append(part * (2**0.5 if order else 1))
    return np.stack(found, axis=1)


def test_they_are_those_of_scipy_without_the_phase():
    directions = torch.randn(200, 3, generator=seeded(0)).double()
    directions = normalize(directions, dim=1)
    orders = [order for degree in range(4) for order in range(-degree, degree + 1)]
    found = spherical_harmonics(directions)
    assert found.shape == (200, CHANNELS)
    wanted = with_phase(directions, 4) * (-1.0) ** np.array(orders)
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-12)

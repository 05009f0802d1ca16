"""Spherical harmonics by what defines them: orthonormal, of their degree, in their order."""

import math

import numpy as np
import torch
from torch import Tensor

from methods.kernels.spherical import CHANNELS, spherical_harmonics


def sphere_quadrature() -> tuple[Tensor, Tensor]:
    """Directions and weights that integrate polynomials up to degree 6 over the sphere exactly."""
    nodes, weights = np.polynomial.legendre.leggauss(8)
    z = torch.tensor(nodes).repeat_interleave(16)
    angle = torch.arange(16, dtype=torch.float64).repeat(8) * (2 * math.pi / 16)
    radius = (1 - z * z).sqrt()
    directions = torch.stack((radius * angle.cos(), radius * angle.sin(), z), dim=1)
    return directions, torch.tensor(weights).repeat_interleave(16) * (2 * math.pi / 16)


def test_they_are_orthonormal():
    directions, weights = sphere_quadrature()
    values = spherical_harmonics(directions)
    gram = (values * weights[:, None]).T @ values
    torch.testing.assert_close(gram, torch.eye(CHANNELS).double(), rtol=0, atol=1e-12)


def test_degree_by_parity_and_order_by_rotation():
    directions, _ = sphere_quadrature()
    values = spherical_harmonics(directions)
    degree = torch.tensor([0] + [1] * 3 + [2] * 5 + [3] * 7)
    # The first degree is the direction, as (y, z, x).
    torch.testing.assert_close(
        values[:, 1:4], math.sqrt(3 / (4 * math.pi)) * directions.roll(-1, dims=1)
    )
    mirrored = spherical_harmonics(-directions)
    torch.testing.assert_close(mirrored, values * (-1.0) ** degree)
    # About z, the pair (l, -m), (l, m) turns by m times the angle.
    angle = 0.7
    x, y, z = directions.unbind(dim=1)
    turned = torch.stack(
        (math.cos(angle) * x - math.sin(angle) * y, math.sin(angle) * x + math.cos(angle) * y, z), 1
    )
    rotated = spherical_harmonics(turned)
    for first, orders in ((0, 0), (1, 1), (4, 2), (9, 3)):
        for m in range(orders + 1):
            sine, cosine = values[:, first + orders - m], values[:, first + orders + m]
            want = math.cos(m * angle) * cosine - math.sin(m * angle) * sine
            torch.testing.assert_close(rotated[:, first + orders + m], want)

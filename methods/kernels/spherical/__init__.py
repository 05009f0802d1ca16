"""Real spherical harmonics of view directions, degrees 0 to 3: 16 values."""

from __future__ import annotations

from torch import Tensor

from bench.types import check_shape
from methods.kernels.dispatch import implementation

CHANNELS = 16


def spherical_harmonics(directions: Tensor, *, backend: str = "auto") -> Tensor:
    """Values at unit `directions` [R, 3]: [R, 16], ordered (l, m) = (0,0) (1,-1) (1,0) ... (3,3).

    Orthonormal over the sphere, without the Condon-Shortley phase, as polynomials in x, y, z.
    Differentiable with backend="reference" only.
    """
    check_shape("directions", directions, None, 3)
    return implementation("spherical", backend, directions.device).spherical_harmonics(directions)

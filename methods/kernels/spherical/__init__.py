"""Real spherical harmonics of view directions, degrees 0 to 3."""

import math

from torch import Tensor

from bench.types import check_shape
from methods.kernels.dispatch import implementation

CHANNELS = 16
RATIOS = (1 / 4, 3 / 4, 15 / 4, 5 / 16, 15 / 16, 35 / 32, 105 / 4, 21 / 32, 7 / 16, 105 / 16)
FACTORS = [math.sqrt(ratio / math.pi) for ratio in RATIOS]
"""Factors of the polynomials, in the order of their first use by degree and order."""


def spherical_harmonics(directions: Tensor, *, backend: str = "auto") -> Tensor:
    """Values at unit `directions` [R, 3]: [R, 16], ordered (l, m) = (0,0) (1,-1) (1,0) ... (3,3).

    Orthonormal over the sphere, without the Condon-Shortley phase, as polynomials in x, y, z.
    Differentiable with backend="reference" only.
    """
    check_shape("directions", directions, None, 3)
    return implementation(__name__, backend, directions.device).spherical_harmonics(directions)

"""Real spherical harmonics of view directions, degrees 0 to 3, and colours made from them."""

from __future__ import annotations

import math

from torch import Tensor

from bench.types import Unavailable, check_shape
from methods.kernels.dispatch import implementation
from methods.kernels.types import expect

CHANNELS = 16
RATIOS = (1 / 4, 3 / 4, 15 / 4, 5 / 16, 15 / 16, 35 / 32, 105 / 4, 21 / 32, 7 / 16, 105 / 16)
FACTORS = [math.sqrt(ratio / math.pi) for ratio in RATIOS]
"""Factors of the polynomials, in the order of their first use by degree and order."""

SIZES = (1, 4, 9, 16)  # number of harmonics up to degree 0, 1, 2 and 3


def spherical_harmonics(directions: Tensor, *, backend: str = "auto") -> Tensor:
    """Values at unit `directions` [R, 3]: [R, 16], ordered (l, m) = (0,0) (1,-1) (1,0) ... (3,3).

    Orthonormal over the sphere, without the Condon-Shortley phase, as polynomials in x, y, z.
    Differentiable with backend="reference" only.
    """
    check_shape("directions", directions, None, 3)
    return implementation(__name__, backend, directions.device).spherical_harmonics(directions)


def shade(coefficients: Tensor, directions: Tensor, *, backend: str = "auto") -> Tensor:
    """Sums of harmonics [N, 3], for each direction weighted with its own coefficients.

    Differentiable in the `coefficients` [N, C, 3], those of the first C harmonics in the order of
    `spherical_harmonics`; C is 1, 4, 9 or 16, for degrees up to 0, 1, 2 or 3. In the unit vectors
    `directions` [N, 3] with backend="reference" only. There is no backend "gpu".
    """
    if backend == "gpu":
        raise Unavailable("backend='gpu': shade has no such version: use backend=auto")
    check_shape("directions", directions, None, 3)
    check_harmonics("coefficients", coefficients, len(directions))
    return implementation(__name__, backend, directions.device).shade(coefficients, directions)


def check_harmonics(name: str, coefficients: Tensor, count: int | None) -> None:
    """Raise ValueError unless `coefficients` [N, C, 3] are those of whole degrees; None: any N."""
    check_shape(name, coefficients, count, None, 3)
    size = coefficients.shape[1]
    expect(size in SIZES, name, f"one of {SIZES} coefficients a colour", size)

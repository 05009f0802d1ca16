"""Spherical harmonics of view directions, and colours, which are sums of them."""

from torch import Tensor

from bench.types import check_shape
from methods.kernels.dispatch import implementation
from methods.kernels.types import expect

SIZES = (1, 4, 9, 16)  # number of harmonics up to degree 0, 1, 2 and 3


def harmonics(directions: Tensor, *, backend: str = "auto") -> Tensor:
    """`spherical_harmonics` of unit vectors `directions` [R, 3]: [R, 16]; differentiable with
    backend="reference" only."""
    check_shape("directions", directions, None, 3)
    return implementation(__name__, backend, directions.device).harmonics(directions)


def shade(coefficients: Tensor, directions: Tensor, *, backend: str = "auto") -> Tensor:
    """Sums of harmonics [N, 3], for each direction weighted with its own coefficients.

    Differentiable in the `coefficients` [N, C, 3], those of the first C harmonics in the order of
    `spherical_harmonics`; C is 1, 4, 9 or 16, for degrees up to 0, 1, 2 or 3. In the unit vectors
    `directions` [N, 3] with backend="reference" only.
    """
    check_shape("directions", directions, None, 3)
    check_harmonics("coefficients", coefficients, len(directions))
    return implementation(__name__, backend, directions.device).shade(coefficients, directions)


def check_harmonics(name: str, coefficients: Tensor, count: int | None) -> None:
    """Raise ValueError unless `coefficients` [N, C, 3] are those of whole degrees; None: any N."""
    check_shape(name, coefficients, count, None, 3)
    size = coefficients.shape[1]
    expect(size in SIZES, name, f"one of {SIZES} coefficients a colour", size)

"""The exponential that becomes vectors, against float64."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numba import njit

from bench.case import U32
from methods.kernels.cpu import EDGE, exp


@njit
def _all(x: np.ndarray, out: np.ndarray) -> None:
    for i in range(len(x)):
        out[i] = exp(x[i])


def test_it_is_exact_to_three_roundings_between_its_ends() -> None:
    x = np.linspace(-EDGE, EDGE, 100_001, dtype=np.float32)
    out = np.empty_like(x)
    _all(x, out)
    assert np.abs(out / np.exp(x.astype(np.float64)) - 1).max() <= 3 * U32


@pytest.mark.parametrize("sign", [1, -1])
def test_it_is_held_beyond_its_ends(sign: int) -> None:
    assert exp(np.float32(sign * math.inf)) == exp(np.float32(sign * EDGE))


def test_nan_stays() -> None:
    assert math.isnan(exp(np.float32(math.nan)))

"""Intervals of means: Student's where values are independent, honest where neighbours are alike."""

import math

import numpy as np
import pytest
from scipy import signal, stats

from bench.rows import half_interval, path_interval

BOTH = pytest.mark.parametrize("half", [half_interval, path_interval])


def paths(rho: float, count: int, frames: int) -> np.ndarray:
    """[count, frames]: AR(1) series of mean 0, from the middle of their course."""
    noise = np.random.default_rng(0).normal(size=(count, 100 + frames))
    return signal.lfilter([1], [1, -rho], noise)[:, 100:]


def coverage(half, series: np.ndarray) -> float:
    """The share of `series` [count, frames] whose interval holds their true mean, 0."""
    return np.mean([abs(values.mean()) <= half(values) for values in series])


def test_independent_values_have_the_interval_of_student():
    values = np.array([1.0, 2.0, 4.0, 9.0])
    low, high = stats.t.interval(0.95, 3, loc=4.0, scale=stats.sem(values))
    assert half_interval(values) == pytest.approx((high - low) / 2)
    assert path_interval(values[:2]) == pytest.approx(half_interval(values[:2]))  # and two frames


@BOTH
@pytest.mark.parametrize("frames", [2, 3, 24, 200])
def test_values_that_are_all_the_same_have_no_width(half, frames):
    assert half(np.full(frames, 30.1)) == pytest.approx(0, abs=1e-12)


@BOTH
@pytest.mark.parametrize("values", [[], [1.0], [1.0, math.inf, 2.0], [1.0, math.nan]])
def test_what_has_no_interval_is_nan(half, values):
    assert math.isnan(half(np.array(values)))


@BOTH
def test_the_interval_has_the_unit_of_the_values_and_no_place_or_direction(half):
    values = paths(0.8, 1, 24)[0]
    assert half(-3 * values[::-1] + 50) == pytest.approx(3 * half(values))


@pytest.mark.parametrize("frames", [24, 200])
def test_frames_that_are_independent_have_about_the_interval_of_student(frames):
    series = paths(0.0, 400, frames)
    assert 0.91 < coverage(path_interval, series) < 0.99
    wider = np.median([path_interval(x) for x in series]) / np.median(
        [half_interval(x) for x in series]
    )
    assert 1 <= wider < {24: 1.4, 200: 1.15}[frames]


def test_where_neighbours_are_alike_the_interval_still_holds_the_mean():
    series = paths(0.8, 400, 100)
    assert coverage(half_interval, series) < 0.6
    assert coverage(path_interval, series) > 0.85

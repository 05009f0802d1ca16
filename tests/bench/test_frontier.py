"""The frontier by what it promises, whatever the settings; power laws by their exponents."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench.accuracy import best_instead, cheapest_within, observed_order

# Few values, so that there are ties.
POINTS = st.lists(st.tuples(st.integers(1, 6), st.integers(-3, 3)), min_size=1, max_size=30)


@given(POINTS)
def test_the_least_error_that_costs_no_more_stands_for_a_setting_and_for_itself(points):
    best = best_instead(*zip(*points, strict=True))
    for (cost, _), instead in zip(points, best, strict=True):
        affordable = [other for other in points if other[0] <= cost]
        assert points[instead] == min(affordable, key=lambda point: (point[1], point[0]))
        assert best[instead] == instead == points.index(points[instead])


@given(POINTS, st.integers(-4, 4))
def test_the_cheapest_within_a_limit_is_the_cheapest_of_those_allowed(points, limit):
    index = cheapest_within(*zip(*points, strict=True), limit)
    allowed = [point for point in points if point[1] <= limit]
    if not allowed:
        assert index is None
    else:
        assert points[index] == min(allowed)


@pytest.mark.parametrize("order", [0.5, 1.0, 2.0, 4.0])
def test_the_order_of_a_power_law_is_its_exponent(order):
    steps = np.geomspace(1e-3, 1, 7)
    assert observed_order(steps, 3 * steps**order) == pytest.approx(order, rel=1e-12)

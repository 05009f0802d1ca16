"""The frontier by what it promises, whatever the settings; power laws by their exponents."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench.frontier import best_instead, cheapest_within, observed_order

# Few values, so that there are ties.
POINTS = st.lists(st.tuples(st.integers(1, 6), st.integers(-3, 3)), min_size=1, max_size=30)


def dominates(one: tuple[int, int], other: tuple[int, int]) -> bool:
    return one[0] <= other[0] and one[1] <= other[1] and one != other


@given(POINTS)
def test_a_setting_stands_for_itself_or_an_equal_exactly_where_nothing_dominates_it(points):
    best = best_instead(*zip(*points, strict=True))
    for point, instead in zip(points, best, strict=True):
        beaten = any(dominates(other, point) for other in points)
        assert beaten == (points[instead] != point)


@given(POINTS)
def test_what_stands_for_a_setting_costs_no_more_and_stands_for_itself(points):
    best = best_instead(*zip(*points, strict=True))
    for (cost, error), instead in zip(points, best, strict=True):
        affordable = [other[1] for other in points if other[0] <= cost]
        assert points[instead][0] <= cost
        assert points[instead][1] == min(affordable) <= error
        assert best[instead] == instead


@given(POINTS, st.randoms(use_true_random=False))
def test_the_frontier_does_not_depend_on_the_order_of_the_settings(points, random):
    def frontier(some: list[tuple[int, int]]) -> set[tuple[int, int]]:
        return {some[index] for index in best_instead(*zip(*some, strict=True))}

    shuffled = random.sample(points, len(points))
    assert frontier(shuffled) == frontier(points)


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

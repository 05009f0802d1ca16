"""What studies make of runs: times that can be compared, the frontier, exponents."""

import math
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from reports.figures import frontier_plot
from reports.studies import Measured, StudyLine, growth, on_frontier, pooled


def line(group: str, label: str, ms: float, psnr: float = 30.0) -> Measured:
    run = SimpleNamespace(values={"psnr": psnr})
    return Measured(StudyLine("ngp", group, label, (label,)), run, ms, 0.9 * ms, 1.2 * ms)


def test_times_of_groups_are_scaled_to_what_all_have():
    usual = [line("a", "off", 50.0, 31.0), line("a", "as it is", 10.0), line("a", "fast", 5.0)]
    busy = [
        line("b", "off", 90.0, 31.0),
        line("b", "as it is", 20.0),
        line("b", "slow", 60.0, 29.0),
    ]
    found = {each.line.label: each for each in pooled([*usual, *busy])}
    assert list(found) == ["off", "as it is", "fast", "slow"]
    assert found["as it is"].ms == 10.0  # the lower median of 10 and 20
    assert found["fast"].ms == 5.0
    assert found["slow"].ms == 30.0  # twice as fast, as "as it is"
    assert (found["slow"].fastest, found["slow"].slowest) == pytest.approx((27.0, 36.0))
    assert found["off"].ms == 45.0  # of 50 and 45
    assert [each.lost for each in found.values()] == [0.0, 1.0, 1.0, 2.0]


# Few values, so that there are ties.
POINTS = st.lists(st.tuples(st.integers(1, 6), st.integers(-3, 3)), min_size=1, max_size=30)


@given(POINTS)
def test_what_no_line_beats_is_on_the_frontier_and_others_name_the_best_instead(points):
    lines = [line("a", str(number), ms, psnr) for number, (ms, psnr) in enumerate(points)]
    for each in on_frontier(lines):
        affordable = [other for other in lines if other.ms <= each.ms]
        best = min(affordable, key=lambda other: (-other.figure("psnr"), other.ms))
        own = (each.ms, each.figure("psnr")) == (best.ms, best.figure("psnr"))
        assert each.better is None or each.better == best.line
        assert each.better is not None or own


def test_a_value_of_0_is_left_out_and_a_single_one_has_no_exponent():
    values = [0.0, 1.0, 7.0]
    assert growth(values, [5.0, 6.0, 12.0]) == pytest.approx(math.log(2) / math.log(7))
    assert math.isnan(growth([2.0, 2.0], [1.0, 1.0]))


def test_the_frontier_is_plotted_also_with_equal_pictures_and_far_points(tmp_path):
    settings = [
        {"setting": name, "knob": knob, "unchanged": name == "as it is", "ms": ms, "ms_lo": ms,
         "ms_hi": ms, "psnr": psnr, "psnr_to_first": math.inf if name == "off" else 40.0,
         "frontier": knob == "stop"}
        for name, knob, ms, psnr in (
            ("off", "stop", 400.0, 30.0), ("as it is", "stop", 100.0, 29.9),
            ("slow", "step", 399.0, 20.0), ("far", "step", 900.0, 20.0),
        )
    ]  # fmt: skip
    frontier_plot(settings, tmp_path / "plot.png")
    assert (tmp_path / "plot.png").stat().st_size > 1000

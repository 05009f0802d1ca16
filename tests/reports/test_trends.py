"""Trends: the difference in the paper and here, its interval, and what may be concluded."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import pytest

from bench.intervals import half_interval, path_interval
from reports.runs import Repeated, Run
from reports.trends import (
    FAILS,
    HOLDS,
    OPEN,
    REVERSED,
    SEEN,
    SMALLER,
    Difference,
    Trend,
    differences,
    trend_table,
)
from tests.reports.conftest import changed, elsewhere, shifted


def between(
    one: list[Run],
    two: list[Run],
    metric: str = "psnr",
    published: Mapping[str, Mapping[str, float]] = {},
) -> list[Difference]:
    """The difference between two lines, if there is one."""
    lines = {"one": Repeated("one", one), "two": Repeated("two", two)}
    return list(differences(Trend(metric, ["one", "two"]), lines, published))


def difference_of(by: float, half: float, paper: float, proves: bool = True) -> Difference:
    return Difference("psnr", "one", "two", paper, by, half, "3 seeds", proves)


@pytest.mark.parametrize(
    ("apart", "verdict"),
    [
        ([0.9, 1.0, 1.1, 0.9, 1.0, 1.1], SEEN),
        ([-0.9, -1.0, -1.1, -0.9, -1.0, -1.1], REVERSED),
        ([1.0, -1.0, 1.0, -1.0, 1.0, -0.9], OPEN),
    ],
)
def test_one_seed_is_compared_frame_by_frame(run, apart, verdict):
    (difference,) = between([run], [shifted(run, apart)])
    assert difference.over == "6 frames of one seed"
    assert difference.by == pytest.approx(np.mean(apart))
    assert difference.half == pytest.approx(path_interval(np.array(apart)))
    assert difference.verdict == verdict


@pytest.mark.parametrize(("by", "verdict"), [(0.1, HOLDS), (-0.1, FAILS)])
def test_several_seeds_are_compared_seed_by_seed(run, by, verdict):
    """Seeds differ by a decibel, the lines by about a tenth with each of them."""
    apart = [by - 0.01, by, by + 0.01]
    one = [shifted(run, seed, seed=seed) for seed in (0, 1, 2)]
    two = [shifted(run, seed + apart[seed], seed=seed) for seed in (2, 0, 1)]
    (difference,) = between(one, two)
    assert difference.over == "3 seeds"
    assert difference.by == pytest.approx(by)
    assert difference.half == pytest.approx(half_interval(np.array(apart)))
    assert difference.verdict == verdict


@pytest.mark.parametrize(
    ("by", "half", "paper", "proves", "verdict"),
    [
        (0.5, 0.4, 1.0, True, HOLDS),
        (0.5, 0.5, 1.0, True, OPEN),  # up to 1.0, as in the paper
        (0.4, 0.5, 1.0, True, SMALLER),  # at most 0.9
        (-0.1, 0.2, 1.0, True, SMALLER),
        (-0.1, 0.2, 1.0, False, OPEN),  # only several seeds show that
        (-0.1, 0.2, math.nan, True, OPEN),
        (-0.5, 0.4, 1.0, True, FAILS),
        (0.0, 0.0, 1.0, True, FAILS),
        (0.5, math.nan, 1.0, True, OPEN),
    ],
)
def test_a_verdict_is_that_of_the_whole_interval(by, half, paper, proves, verdict):
    assert difference_of(by, half, paper, proves).verdict == verdict


def test_the_papers_difference_is_known_where_both_its_figures_are(run):
    published = {"one": {"psnr": 31.0}, "two": {"psnr": 31.5}}
    (known,) = between([run], [run], published=published)
    assert known.paper == pytest.approx(0.5)
    (unknown,) = between([run], [run], published={**published, "two": {}})
    assert math.isnan(unknown.paper)


def test_a_line_of_the_table_has_both_differences_in_the_unit_of_the_metric():
    size = Difference("size_bytes.total", "one", "two", 21e6, 2e6, 0.0, "computed", True)
    found = [difference_of(-0.481, 0.15, 0.61), difference_of(0.5, math.nan, math.nan), size]
    assert trend_table(found).lines == (
        ("PSNR, dB: one < two", "+0.61", "-0.48 ± 0.15", "3 seeds", FAILS),
        ("PSNR, dB: one < two", "", "+0.50", "3 seeds", OPEN),
        ("model, MB: one < two", "+21.00", "+2.00", "computed", HOLDS),
    )


def test_seeds_that_only_one_line_has_are_left_out(run):
    one = [shifted(run, 0, seed=0), shifted(run, 9, seed=1)]
    (difference,) = between(one, [shifted(run, 1, seed=0)])
    assert difference.over == "6 frames of one seed"
    assert difference.by == pytest.approx(1)


def test_a_figure_without_frames_alone_tells_nothing_but_bytes_are_computed(run):
    larger = changed(run, {"size_bytes.total": run.values["size_bytes.total"] + 1})
    (difference,) = between([run], [larger], "fps")
    assert difference.verdict == OPEN
    (difference,) = between([run], [larger], "size_bytes.total")
    assert (difference.half, difference.verdict) == (0.0, HOLDS)


def test_a_line_not_measured_has_no_difference_nor_have_times_of_different_machines(run):
    assert between([run], []) == between([run], [elsewhere(run)], "frame_ms") == []
    assert between([run], [elsewhere(run)])

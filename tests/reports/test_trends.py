"""Trends: the difference in the paper and here, its interval, and what may be concluded."""

from __future__ import annotations

import math
from dataclasses import replace

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

TREND = Trend("psnr", ["one", "two"])


def changed(run: Run, by: float | list[float], seed: int = 5) -> Run:
    """`run` with a PSNR larger by so much, of every frame and in the mean, with another seed."""
    rows = run.rows.assign(seed=seed)
    rows.loc[rows["metric"] == "psnr", "value"] += np.mean(by)
    frames = run.frames.assign(psnr=run.frames["psnr"] + by)
    return replace(run, rows=rows, read_frames=lambda: frames)


def only(one: list[Run], two: list[Run]):
    (difference,) = differences(
        TREND, {"one": Repeated("one", one), "two": Repeated("two", two)}, {}
    )
    return difference


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
    difference = only([run], [changed(run, apart)])
    assert difference.over == "6 frames of one seed"
    assert difference.by == pytest.approx(np.mean(apart))
    assert difference.half == pytest.approx(path_interval(np.array(apart)))
    assert difference.verdict == verdict


@pytest.mark.parametrize(("by", "verdict"), [(0.1, HOLDS), (-0.1, FAILS)])
def test_several_seeds_are_compared_seed_by_seed(run, by, verdict):
    """Seeds differ by a decibel, the lines by about a tenth with each of them."""
    apart = [by - 0.01, by, by + 0.01]
    one = [changed(run, seed, seed) for seed in (0, 1, 2)]
    two = [changed(run, seed + apart[seed], seed) for seed in (2, 0, 1)]
    difference = only(one, two)
    assert difference.over == "3 seeds"
    assert difference.by == pytest.approx(by)
    assert difference.half == pytest.approx(half_interval(np.array(apart)))
    assert difference.verdict == verdict


@pytest.mark.parametrize(
    ("by", "half", "verdict"),
    [
        (0.5, 0.4, HOLDS),
        (0.5, 0.5, OPEN),  # up to 1.0, as in the paper
        (0.4, 0.5, SMALLER),  # at most 0.9
        (-0.1, 0.2, SMALLER),
        (-0.5, 0.4, FAILS),
        (0.0, 0.0, FAILS),
        (0.5, math.nan, OPEN),
    ],
)
def test_several_seeds_against_a_difference_of_one_decibel_in_the_paper(by, half, verdict):
    assert difference_of(by, half, paper=1.0).verdict == verdict


def test_only_several_seeds_show_that_a_difference_is_smaller_than_a_published_one():
    assert difference_of(-0.1, 0.2, paper=math.nan).verdict == OPEN
    assert difference_of(-0.1, 0.2, paper=1.0, proves=False).verdict == OPEN


def test_the_papers_difference_is_known_where_both_its_figures_are(run):
    lines = {name: Repeated(name, [run]) for name in ("one", "two")}
    published = {"one": {"psnr": 31.0}, "two": {"psnr": 31.5}}
    (difference,) = differences(TREND, lines, published)
    assert difference.paper == pytest.approx(0.5)
    (difference,) = differences(TREND, lines, {**published, "two": {}})
    assert math.isnan(difference.paper)


def test_a_line_of_the_table_has_both_differences_in_the_unit_of_the_metric():
    size = Difference("size_bytes.total", "one", "two", 21e6, 2e6, 0.0, "computed", True)
    found = [difference_of(-0.481, 0.15, 0.61), difference_of(0.5, math.nan, math.nan), size]
    assert trend_table(found).lines == (
        ("PSNR, dB: one < two", "+0.61", "-0.48 ± 0.15", "3 seeds", FAILS),
        ("PSNR, dB: one < two", "", "+0.50", "3 seeds", OPEN),
        ("model, MB: one < two", "+21.00", "+2.00", "computed", HOLDS),
    )


def test_seeds_that_only_one_line_has_are_left_out(run):
    difference = only([changed(run, 0, 0), changed(run, 9, 1)], [changed(run, 1, 0)])
    assert difference.over == "6 frames of one seed"
    assert difference.by == pytest.approx(1)


def test_a_figure_without_frames_alone_tells_nothing(run):
    trend = Trend("fps", ["one", "two"])
    lines = {name: Repeated(name, [run]) for name in ("one", "two")}
    (difference,) = differences(trend, lines, {})
    assert difference.verdict == OPEN


def test_bytes_are_computed_and_need_no_interval(run):
    larger = replace(run, rows=run.rows.assign(value=run.rows["value"] + 1))
    lines = {"one": Repeated("one", [run]), "two": Repeated("two", [larger])}
    (difference,) = differences(Trend("size_bytes.total", ["one", "two"]), lines, {})
    assert (difference.half, difference.verdict) == (0.0, HOLDS)


def test_a_line_that_was_not_measured_has_no_difference(run):
    lines = {"one": Repeated("one", [run]), "two": Repeated("two", [])}
    assert list(differences(TREND, lines, {})) == []


def test_times_of_different_machines_tell_nothing(run):
    machine = {**run.record["machine"], "cpu": "another"}
    elsewhere = replace(run, record={**run.record, "machine": machine})
    lines = {"one": Repeated("one", [run]), "two": Repeated("two", [elsewhere])}
    assert not list(differences(Trend("frame_ms", ["one", "two"]), lines, {}))
    assert list(differences(TREND, lines, {}))

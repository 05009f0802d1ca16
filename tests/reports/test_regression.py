"""What counts as worse: limits, directions, pairs of frames, chance, other machines."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from bench.errors import SteerbenchError
from bench.intervals import half_interval, path_interval
from reports.regression import LIMITS, Change, Figures, Limit, changes

OLD = Figures(
    {"psnr": 30.0, "frame_ms": 100.0, "size_bytes.total": 1000.0}, {}, "one machine", "views"
)


def change(metric: str, value: float, old: Figures = OLD) -> Change | None:
    new = replace(old, values={**old.values, metric: value})
    return next((found for found in changes([old], [new]) if found.metric == metric), None)


@pytest.mark.parametrize(
    ("metric", "value", "worse"),
    [
        ("psnr", 29.95, False),
        ("psnr", 29.85, True),
        ("psnr", 40.0, False),
        ("frame_ms", 120.0, False),
        ("frame_ms", 130.0, True),
        ("frame_ms", 10.0, False),
        ("size_bytes.total", 1002.0, True),
    ],
)
def test_worse_is_what_passes_the_limit_in_the_wrong_direction(metric, value, worse):
    found = change(metric, value)
    assert found is not None
    assert found.verdict == ("worse" if worse else "")


def test_what_depends_on_the_machine_is_compared_on_the_same_one_only():
    other = replace(OLD, machine="another machine", values={**OLD.values, "frame_ms": 500.0})
    assert {found.metric for found in changes([OLD], [other])} == {"psnr", "size_bytes.total"}


@pytest.mark.parametrize(
    ("by", "verdict"),
    [
        ([-0.3, -0.2, -0.4, -0.3], "worse"),
        ([-1.0] * 13 + [0.8] * 11, ""),  # -0.175 dB in the mean, but the interval contains 0
        ([-0.05] * 24, ""),  # certain, but within the limit
        ([0.0] * 23 + [-20.0], "worse"),  # one frame is broken
    ],
)
def test_frames_that_both_have_are_compared_in_pairs(by, verdict):
    before = {str(i): 20.0 + 5 * i for i in range(len(by))}
    after = {name: value + by[int(name)] for name, value in before.items()} | {"more": 99.0}
    old, new = (replace(OLD, frames={"psnr": frames}) for frames in (before, after))
    found = next(found for found in changes([old], [new]) if found.metric == "psnr")
    half = path_interval(np.array(by))
    assert found.by == pytest.approx(np.mean(by))
    assert found.interval == pytest.approx((found.by - half, found.by + half))
    assert found.verdict == verdict


@pytest.mark.parametrize("metric", ["work.samples", "work.products"])
def test_more_work_is_worse_on_any_machine(metric):
    old = replace(OLD, values={metric: 1e6})
    found = [
        next(changes([old], [replace(old, values={metric: work}, machine="another")])).verdict
        for work in (1.04e6, 1.06e6)
    ]
    assert found == ["", "worse"]


def test_frames_without_an_error_hide_no_others():
    """Equal pictures have an infinite PSNR, before and after."""
    before = {str(i): 30.0 for i in range(9)} | {"9": math.inf}
    after = {str(i): 20.0 for i in range(9)} | {"9": math.inf}
    values = {**OLD.values, "psnr": math.inf}
    old, new = (Figures(values, {"psnr": psnr}, "one", "views") for psnr in (before, after))
    found = next(each for each in changes([old], [new]) if each.metric == "psnr")
    assert found.by == pytest.approx(-9)
    assert found.verdict == "worse"
    assert next(changes([old], [old])).verdict == ""


def test_one_slow_frame_among_many_is_chance():
    times = {str(i): 100.0 for i in range(24)}
    old = replace(OLD, frames={"frame_ms": times})
    new = replace(OLD, frames={"frame_ms": {**times, "11": 2000.0}})
    found = next(each for each in changes([old], [new]) if each.metric == "frame_ms")
    assert found.by > 25
    assert found.verdict == ""


def seeds(*by: float, metric: str = "psnr") -> Change:
    """PSNR of a run with so many seeds, each of which changed by so much in all of its frames."""
    before = [{str(i): 25.0 + seed + i for i in range(6)} for seed in range(len(by))]
    after = [
        {name: value + each for name, value in frames.items()}
        for frames, each in zip(before, by, strict=True)
    ]
    old, new = ([replace(OLD, frames={metric: x}) for x in runs] for runs in (before, after))
    return next(found for found in changes(old, new) if found.metric == metric)


def test_seeds_of_which_some_became_better_have_changed_by_chance():
    """All frames of a training change alike, so that those of one seed would call it worse."""
    found = seeds(-0.6, 0.2, -0.4)
    assert found.by == pytest.approx(-0.8 / 3)
    half = half_interval(np.array([-0.6, 0.2, -0.4]))
    assert found.interval == pytest.approx((found.by - half, found.by + half))
    assert found.verdict == ""
    assert seeds(-0.6).verdict == seeds(-0.6, -0.5, -0.7).verdict == "worse"


def test_one_broken_frame_of_one_seed_is_worse():
    whole = replace(OLD, frames={"psnr": {str(i): 30.0 for i in range(6)}})
    broken = replace(OLD, frames={"psnr": {**whole.frames["psnr"], "3": 10.0}})
    found = next(changes([whole] * 3, [whole, broken, whole]))
    assert found.verdict == "worse"


def test_a_metric_that_one_seed_lacks_is_missing():
    lacking = replace(OLD, values={"frame_ms": 100.0})
    assert next(changes([OLD, OLD], [OLD, lacking])).verdict == "missing"


def test_a_metric_or_a_frame_that_is_gone_is_missing():
    gone = replace(OLD, values={"frame_ms": 100.0, "size_bytes.total": 1000.0})
    assert {found.metric: found.verdict for found in changes([OLD], [gone])}["psnr"] == "missing"
    old = replace(OLD, frames={"psnr": {"0": 30.0, "1": 30.0, "2": 30.0}})
    new = replace(OLD, frames={"psnr": {"0": 30.0, "1": 30.0}})
    assert next(changes([old], [new])).verdict == "missing"


def test_figures_of_other_frames_are_not_compared():
    with pytest.raises(SteerbenchError, match=r"of other frames, .*: views; another scene"):
        list(changes([OLD], [replace(OLD, views="another scene")]))


def test_a_baseline_can_have_limits_of_its_own():
    new = replace(OLD, values={**OLD.values, "psnr": 29.0})
    (wide,) = changes([OLD], [new], {"psnr": Limit(1, absolute=2.0)})
    assert wide.verdict == ""
    assert LIMITS["psnr"].absolute < 1


def test_frames_are_those_that_the_headline_is_the_mean_of(run):
    table = run.frames.assign(psnr=[30.0, *[math.nan] * (len(run.frames) - 1)], peak_bytes=1.0)
    figures = Figures.of(replace(run, read_frames=lambda: table))
    assert len(figures.frames["psnr"]) == 1  # the others have no truth
    assert list(figures.frames["frame_ms"].values()) == table["frame_ms"].tolist()
    assert "peak_bytes" in figures.values
    assert "peak_bytes" not in figures.frames  # its headline was the largest of older runs


def test_a_metric_that_only_the_baseline_has_a_limit_for_is_kept(run):
    assert set(Figures.of(run, {"train_s": Limit(-1)}).values) == {"train_s"}

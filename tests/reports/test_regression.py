"""What counts as worse: limits, directions, pairs of frames, chance, other machines."""

import math
from dataclasses import replace

import numpy as np
import pytest

from bench.rows import half_interval, path_interval
from reports.regression import LIMITS, Assertion, Figures, Limit, changes, limited
from tests.common import refusal

OLD = Figures(
    {"psnr": 30.0, "frame_ms": 100.0, "size_bytes.total": 1000.0}, {}, "one machine", "views"
)


def change(metric: str, old: list[Figures], new: list[Figures]) -> Assertion:
    (found,) = (found for found in changes(old, new) if found.metric == metric)
    return found


def with_frames(metric: str, *figures: float) -> Figures:
    return replace(OLD, frames={metric: {str(i): value for i, value in enumerate(figures)}})


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
    found = change(metric, [OLD], [replace(OLD, values={**OLD.values, metric: value})])
    assert found.verdict == ("worse" if worse else "")


def test_what_depends_on_the_machine_is_compared_on_the_same_one_only():
    values = {**OLD.values, "frame_ms": 500.0, "work.samples": 1.06e6}
    old = replace(OLD, values={**OLD.values, "work.samples": 1e6})
    found = changes([old], [replace(OLD, machine="another machine", values=values)])
    assert {each.metric: each.verdict for each in found} == {
        "psnr": "",
        "size_bytes.total": "",
        "work.samples": "worse",
    }


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
    before = [20.0 + 5 * i for i in range(len(by))]
    after = [*(value + each for value, each in zip(before, by, strict=True)), 99.0]
    found = change("psnr", [with_frames("psnr", *before)], [with_frames("psnr", *after)])
    half = path_interval(np.array(by))
    assert found.change == pytest.approx(np.mean(by))
    assert found.interval == pytest.approx((found.change - half, found.change + half))
    assert found.verdict == verdict


@pytest.mark.parametrize("before", [math.inf, 30.0])
def test_frames_without_an_error_hide_no_others(before):
    """Equal pictures have an infinite PSNR."""
    old, new = (
        replace(with_frames("psnr", *[psnr] * 9, last), values={"psnr": math.inf})
        for psnr, last in ((30.0, before), (20.0, math.inf))
    )
    found = change("psnr", [old], [new])
    assert (found.change, found.verdict) == (pytest.approx(-9), "worse")
    assert change("psnr", [old], [old]).verdict == ""


def test_one_slow_frame_among_many_is_chance():
    new = with_frames("frame_ms", *[100.0] * 11, 2000.0, *[100.0] * 12)
    found = change("frame_ms", [with_frames("frame_ms", *[100.0] * 24)], [new])
    assert found.change > 25
    assert found.verdict == ""


def seeds(*by: float) -> Assertion:
    """PSNR of a run with so many seeds, each of which changed by so much in all of its frames."""
    before = [np.arange(25.0 + seed, 31.0 + seed) for seed in range(len(by))]
    old = [with_frames("psnr", *frames) for frames in before]
    new = [with_frames("psnr", *frames + each) for frames, each in zip(before, by, strict=True)]
    return change("psnr", old, new)


def test_seeds_of_which_some_became_better_have_changed_by_chance():
    """All frames of a training change alike, so that those of one seed would call it worse."""
    found = seeds(-0.6, 0.2, -0.4)
    assert found.change == pytest.approx(-0.8 / 3)
    half = half_interval(np.array([-0.6, 0.2, -0.4]))
    assert found.interval == pytest.approx((found.change - half, found.change + half))
    assert found.verdict == ""
    assert seeds(-0.6).verdict == seeds(-0.6, -0.5, -0.7).verdict == "worse"


def test_one_broken_frame_of_one_seed_is_worse():
    whole, broken = with_frames("psnr", *[30.0] * 6), with_frames("psnr", *[30.0] * 5, 10.0)
    assert change("psnr", [whole] * 3, [whole, broken, whole]).verdict == "worse"


def test_a_metric_or_a_frame_that_is_gone_is_missing():
    gone = replace(OLD, values={"frame_ms": 100.0, "size_bytes.total": 1000.0})
    assert change("psnr", [OLD], [gone]).verdict == "missing"
    assert change("psnr", [OLD, OLD], [OLD, gone]).verdict == "missing"
    old, new = with_frames("psnr", 30.0, 30.0, 30.0), with_frames("psnr", 30.0, 30.0)
    assert change("psnr", [old], [new]).verdict == "missing"


def test_a_baseline_can_have_limits_of_its_own():
    new = replace(OLD, values={**OLD.values, "psnr": 29.0})
    (wide,) = changes([OLD], [new], {"psnr": Limit(1, absolute=2.0)})
    assert wide.verdict == ""
    assert LIMITS["psnr"].absolute < 1


def test_an_assertion_says_by_how_much_and_against_which_limit():
    new = replace(OLD, values={**OLD.values, "psnr": 28.766, "frame_ms": 131.0})
    assert str(change("psnr", [OLD], [new])) == "psnr -1.23 dB (limit 0.1)"
    assert str(change("frame_ms", [OLD], [new])) == "frame_ms +31 % (limit 25 %)"


def test_limits_are_typed_in_the_unit_of_the_metric_or_as_a_share():
    found = limited(["psnr=0.2", "frame_ms=10%", "flicker=0.01"], {"psnr": LIMITS["psnr"]})
    times = Limit(-1, relative=0.1, here=True, unit="ms")
    psnr, flicker = Limit(1, absolute=0.2, unit="dB"), Limit(-1, absolute=0.01)
    assert found == {"psnr": psnr, "frame_ms": times, "flicker": flicker}
    for word, said in (("pnsr=1", "Did you mean psnr"), ("psnr=-1", "got -1"), ("psnr", "nothing")):
        with refusal(said):
            limited([word])


def test_frames_are_those_that_the_headline_is_the_mean_of(run):
    missing = [math.nan] * (len(run.frames) - 2)
    scored = {"psnr": [30.0, 30.0, *missing], "ssim": [0.9, math.nan, *missing]}
    table = run.frames.assign(**scored)
    figures = Figures.of(replace(run, read_frames=lambda: table))
    assert len(figures.frames["psnr"]) == 2  # the others have no truth
    assert len(figures.frames["ssim"]) == 1  # like LPIPS, which may be left out of a frame
    assert list(figures.frames["frame_ms"].values()) == table["frame_ms"].tolist()
    assert "peak_bytes" in figures.values
    assert "peak_bytes" not in figures.frames

"""Trends: which step holds, over what its interval is, and what cannot be told."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bench.intervals import half_interval
from reports.runs import Repeated, Run, load
from reports.trends import FAILS, HOLDS, OPEN, REVERSED, SEEN, Trend, steps

TREND = Trend("psnr", ["one", "two"])


@pytest.fixture
def run(store, stored_run: str) -> Run:
    """A run of six scored frames."""
    return load(store, {stored_run: "run"})[0]


def changed(run: Run, by: float | list[float], seed: int = 5) -> Run:
    """`run` with a PSNR larger by so much, of every frame and in the mean, with another seed."""
    rows = run.rows.assign(seed=seed)
    rows.loc[rows["metric"] == "psnr", "value"] += np.mean(by)
    frames = run.frames.assign(psnr=run.frames["psnr"] + by)
    return replace(run, rows=rows, read_frames=lambda: frames)


def only(one: list[Run], two: list[Run]):
    (step,) = steps(TREND, {"one": Repeated("one", one), "two": Repeated("two", two)})
    return step


@pytest.mark.parametrize(
    ("apart", "verdict"),
    [
        ([0.9, 1.0, 1.1, 0.9, 1.0, 1.1], SEEN),
        ([-0.9, -1.0, -1.1, -0.9, -1.0, -1.1], REVERSED),
        ([1.0, -1.0, 1.0, -1.0, 1.0, -0.9], OPEN),
    ],
)
def test_one_seed_is_compared_frame_by_frame(run: Run, apart: list[float], verdict: str) -> None:
    step = only([run], [changed(run, apart)])
    assert step.over == "6 frames of one seed"
    assert step.by == pytest.approx(np.mean(apart))
    assert step.half == pytest.approx(half_interval(np.array(apart)))
    assert step.verdict == verdict


@pytest.mark.parametrize(("by", "verdict"), [(0.1, HOLDS), (-0.1, FAILS)])
def test_several_seeds_are_compared_seed_by_seed(run: Run, by: float, verdict: str) -> None:
    """Seeds differ by a decibel, the lines by a tenth with each of them."""
    one = [changed(run, seed, seed) for seed in (0, 1, 2)]
    two = [changed(run, seed + by, seed) for seed in (2, 0, 1)]
    step = only(one, two)
    assert step.over == "3 seeds"
    assert step.by == pytest.approx(by)
    assert step.verdict == verdict


def test_seeds_that_only_one_line_has_are_left_out(run: Run) -> None:
    step = only([changed(run, 0, 0), changed(run, 9, 1)], [changed(run, 1, 0)])
    assert step.over == "6 frames of one seed"
    assert step.by == pytest.approx(1)


def test_a_figure_without_frames_alone_tells_nothing(run: Run) -> None:
    trend = Trend("fps", ["one", "two"])
    lines = {name: Repeated(name, [run]) for name in ("one", "two")}
    (step,) = steps(trend, lines)
    assert step.verdict == OPEN


def test_bytes_are_computed_and_need_no_interval(run: Run) -> None:
    larger = replace(run, rows=run.rows.assign(value=run.rows["value"] + 1))
    lines = {"one": Repeated("one", [run]), "two": Repeated("two", [larger])}
    (step,) = steps(Trend("size_bytes.total", ["one", "two"]), lines)
    assert (step.half, step.verdict) == (0.0, HOLDS)


def test_a_line_that_was_not_measured_has_no_step(run: Run) -> None:
    lines = {"one": Repeated("one", [run]), "two": Repeated("two", [])}
    assert list(steps(TREND, lines)) == []


def test_times_of_different_machines_tell_nothing(run: Run) -> None:
    machine = {**run.record["machine"], "cpu": "another"}
    elsewhere = replace(run, record={**run.record, "machine": machine})
    lines = {"one": Repeated("one", [run]), "two": Repeated("two", [elsewhere])}
    assert not list(steps(Trend("frame_ms", ["one", "two"]), lines))
    assert list(steps(TREND, lines))

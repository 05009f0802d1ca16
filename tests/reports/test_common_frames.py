"""Figures over the frames that are steady in all runs of a table."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest

from bench.results import COLD, STEADY
from bench.run import phase_rows
from reports.runs import Run, over_common_frames

PSNR = [20.0, 26.0, 29.0, 30.0, 31.0, 30.0]
"""Of the frames of a path: the first are harder, for every method alike."""


def run_of(memory: int, scene: str = "one", shift: float = 0.0) -> Run:
    """A run whose first `memory` frames are cold."""
    frames = pd.DataFrame(
        {
            "frame": range(len(PSNR)),
            "name": [f"r_{k}" for k in range(len(PSNR))],
            "phase": [COLD if k < memory else STEADY for k in range(len(PSNR))],
            "psnr": [value + shift for value in PSNR],
            "flicker": [float("nan")] + [0.1] * (len(PSNR) - 1),
            "frame_ms": [10.0 + k for k in range(len(PSNR))],
            "stage_ms.other": [10.0 + k for k in range(len(PSNR))],
        }
    )
    rows = [
        row | {"phase": phase}
        for phase in (STEADY, COLD)
        if len(of_phase := frames[frames["phase"] == phase])
        for row in phase_rows(of_phase)
    ]
    facts = {"run": "key", "split": "test", "trajectory": "orbit", "resolution": "8x8"}
    record = {"scene": {"digest": scene}}
    return Run("key", "run", pd.DataFrame(rows).assign(**facts), lambda: frames, record, Path())


def test_equal_pictures_have_equal_figures_whatever_the_method_remembers():
    runs = over_common_frames([run_of(memory) for memory in (0, 1, 3)])
    for run in runs:
        assert run.values["psnr"] == pytest.approx(sum(PSNR[3:]) / 3)
        assert run.values["frame_ms"] == run.values["stage_ms.other"] == pytest.approx(14)
        assert run.values["fps"] == pytest.approx(1000 / 14)
        assert run.headline["n"]["psnr"] == 3


def test_figures_of_cold_frames_stay():
    run = over_common_frames([run_of(1), run_of(3)])[0]
    cold = run.rows[run.rows["phase"] == COLD].set_index("metric")["value"]
    assert cold["psnr"] == PSNR[0]


def test_runs_of_other_views_do_not_count():
    alone, other = over_common_frames([run_of(0), run_of(3, scene="another")])
    assert alone.values["psnr"] == pytest.approx(sum(PSNR) / 6)
    assert other.values["psnr"] == pytest.approx(sum(PSNR[3:]) / 3)


def test_without_a_common_frame_all_stay_as_they_are():
    cold = run_of(len(PSNR))
    runs = over_common_frames([run_of(0), cold])
    assert runs[0].values["psnr"] == pytest.approx(sum(PSNR) / 6)
    assert runs[1] is cold

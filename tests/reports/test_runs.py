"""Runs over the frames that are steady in all of them, and means of runs of several scenes."""

import math
from dataclasses import replace

import pandas as pd
import pytest

from bench.results import COLD, STEADY
from bench.rows import phase_rows
from reports.paper_tables import Line, PaperTable, Place, section
from reports.publish import markdown
from reports.runs import Repeated, Run, over_common_frames, over_scenes
from tests.reports.conftest import elsewhere, of_scene, run_of

PSNR = [20.0, 26.0, 29.0, 30.0, 31.0, 30.0]
"""Of the frames of a path: the first are harder, for every method alike."""


def remembering(memory: int, scene: str = "one") -> Run:
    """A run whose first `memory` frames are cold."""
    ms = [10.0 + k for k in range(6)]
    frames = pd.DataFrame(
        {
            "frame": range(6),
            "name": [f"r_{k}" for k in range(6)],
            "phase": [COLD] * memory + [STEADY] * (6 - memory),
            "psnr": PSNR,
            "flicker": [math.nan] + [0.1] * 5,
            "frame_ms": ms,
            "stage_ms.other": ms,
        }
    )
    rows = [
        row | {"phase": phase}
        for phase, of_phase in frames.groupby("phase")
        for row in phase_rows(of_phase)
    ]
    facts = {"run": "key", "split": "test", "trajectory": "orbit", "resolution": "8x8"}
    run = run_of(pd.DataFrame(rows).assign(**facts), scene={"digest": scene})
    return replace(run, read_frames=lambda: frames)


def test_a_run_is_shown_by_key_and_label_alone():
    run = remembering(1)
    assert repr(run) == f"Run(key={run.key!r}, label={run.label!r})"


def test_equal_pictures_have_equal_figures_whatever_the_method_remembers():
    runs = over_common_frames([remembering(memory) for memory in (0, 1, 3)])
    for run in runs:
        assert run.values["psnr"] == pytest.approx(sum(PSNR[3:]) / 3)
        assert run.values["frame_ms"] == run.values["stage_ms.other"] == pytest.approx(14)
        assert run.values["fps"] == pytest.approx(1000 / 14)
        assert run.headline["n"]["psnr"] == 3
    cold = runs[1].rows[runs[1].rows["phase"] == COLD].set_index("metric")["value"]
    assert cold["psnr"] == PSNR[0]


def test_runs_of_other_views_and_runs_without_a_steady_frame_do_not_count():
    cold = remembering(6)
    alone, other, same = over_common_frames([remembering(0), remembering(3, scene="another"), cold])
    assert alone.values["psnr"] == pytest.approx(sum(PSNR) / 6)
    assert other.values["psnr"] == pytest.approx(sum(PSNR[3:]) / 3)
    assert same is cold


def test_the_headline_is_steady_where_a_run_has_steady_frames(rows, rows_with_cold):
    assert run_of(rows_with_cold).values == pytest.approx(run_of(rows).values, nan_ok=True)
    cold = run_of(rows_with_cold[rows_with_cold["phase"] != "steady"])
    assert cold.values["psnr"] == pytest.approx(27.456)
    assert cold.values["train_s"] == 61


def test_figures_are_means_and_facts_that_differ_are_listed(run):
    mean = over_scenes([of_scene(run, "a"), of_scene(run, "b", 4.0, resolution="8x8")])
    assert mean.values["psnr"] == pytest.approx(run.values["psnr"] + 2.0)
    assert mean.values["size_bytes.total"] == run.values["size_bytes.total"]
    assert mean.facts["scene"] == "mean of a, b"
    assert mean.facts["resolution"] == "40x32 / 8x8"
    assert mean.facts["seed"] == run.facts["seed"]
    assert over_scenes([run]) is run


def test_a_figure_that_one_scene_lacks_has_no_mean_but_time_and_work_are_0_there(run):
    missing = run.rows["metric"].isin(["ssim", "stage_ms.look-up", "work.pixels"])
    less = replace(run, rows=run.rows[~missing])
    mean = over_scenes([of_scene(run, "a"), of_scene(less, "b", math.nan)])
    assert "ssim" not in mean.values
    assert math.isnan(mean.values["psnr"])
    for metric in ("stage_ms.look-up", "work.pixels"):
        assert mean.values[metric] == run.values[metric] / 2


def test_other_scenes_and_other_machines_are_other_conditions(run):
    a, b, c = (of_scene(run, name) for name in "abc")
    assert over_scenes([a, b]).conditions == over_scenes([a, b]).conditions
    assert over_scenes([a, b]).conditions != over_scenes([a, c]).conditions
    assert over_scenes([a, elsewhere(b)]).computer != run.computer


def test_a_single_scene_has_no_line_beside_its_mean(run, tmp_path):
    table = PaperTable("table9", "t", ["psnr"], {"x": Line("x", {})}, scenes=["psnr"])
    measured = {Place("table9", "", "x"): Repeated("x", [run], by_scene={"a": [run]})}
    shown = markdown(section(table, measured), tmp_path)
    assert "| x | " in shown
    assert "a: x" not in shown

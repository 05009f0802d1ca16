"""The mean of runs of several scenes as a run, and what trends and pages read of it."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from reports.scenes import over_scenes

from reports.paper_tables import Line, PaperTable, section
from reports.publish import markdown
from reports.runs import Repeated, Run
from reports.trends import SEEN, Trend, differences


def of_scene(run: Run, scene: str, by: float = 0.0, **facts: object) -> Run:
    """`run` as that of another scene, with a PSNR larger by so much."""
    rows = run.rows.assign(scene=scene, **facts)
    rows.loc[rows["metric"] == "psnr", "value"] += by
    frames = run.frames.assign(psnr=run.frames["psnr"] + by)
    record = {**run.record, "scene": {**run.record["scene"], "digest": scene}}
    changed = replace(run, key=f"{run.key}-{scene}", rows=rows, record=record)
    return replace(changed, read_frames=lambda: frames)


def test_figures_are_means_and_facts_that_differ_are_listed(run):
    mean = over_scenes([of_scene(run, "a"), of_scene(run, "b", 4.0, resolution="8x8")])
    assert mean.values["psnr"] == pytest.approx(run.values["psnr"] + 2.0)
    assert mean.values["size_bytes.total"] == run.values["size_bytes.total"]
    assert mean.facts["scene"] == "mean of a, b"
    assert mean.facts["resolution"] == "40x32 / 8x8"
    assert mean.facts["seed"] == run.facts["seed"]


def test_the_mean_of_one_scene_is_its_run(run):
    assert over_scenes([run]) is run


def test_a_figure_that_one_scene_lacks_has_no_mean_but_time_and_work_are_0_there(run):
    missing = run.rows["metric"].isin(["ssim", "stage_ms.look-up", "work.pixels"])
    less = replace(run, rows=run.rows[~missing])
    mean = over_scenes([of_scene(run, "a"), of_scene(less, "b")])
    assert "ssim" not in mean.values
    for metric in ("stage_ms.look-up", "work.pixels"):
        assert mean.values[metric] == run.values[metric] / 2


def test_a_figure_that_is_not_available_in_one_scene_is_not_in_the_mean(run):
    mean = over_scenes([of_scene(run, "a"), of_scene(run, "b", math.nan)])
    assert math.isnan(mean.values["psnr"])


def test_other_scenes_are_other_conditions(run):
    a, b, c = (of_scene(run, name) for name in "abc")
    assert over_scenes([a, b]).conditions == over_scenes([a, b]).conditions
    assert over_scenes([a, b]).conditions != over_scenes([a, c]).conditions


def test_scenes_of_different_machines_are_not_of_one(run):
    machine = {**run.record["machine"], "cpu": "another"}
    elsewhere = replace(of_scene(run, "b"), record={**run.record, "machine": machine})
    assert over_scenes([of_scene(run, "a"), elsewhere]).computer != run.computer


def test_one_seed_is_compared_over_the_frames_of_all_scenes(run):
    one = over_scenes([of_scene(run, "a"), of_scene(run, "b")])
    other = over_scenes([of_scene(run, "a", 1.0), of_scene(run, "b", 2.0)])
    lines = {"one": Repeated("one", [one]), "two": Repeated("two", [other])}
    (found,) = differences(Trend("psnr", ["one", "two"]), lines, {})
    assert (found.over, found.verdict) == ("12 frames of one seed", SEEN)
    assert found.by == pytest.approx(1.5)


@pytest.mark.parametrize("scenes", ["ab", "a"])
def test_each_scene_has_its_line_where_there_are_several(run, scenes, tmp_path):
    table = PaperTable("table9", "t", "p", ["psnr"], [Line("x", {})], [], scenes=["psnr"])
    by_scene = {name: [of_scene(run, name, place)] for place, name in enumerate(scenes)}
    mean = over_scenes([of_one for (of_one,) in by_scene.values()])
    shown = markdown(section(table, [Repeated("x", [mean], by_scene=by_scene)]), tmp_path)
    lines = [f"| {name}: x | {run.values['psnr'] + place:.2f} |" for place, name in enumerate("ab")]
    assert all((line in shown) == (len(scenes) > 1) for line in lines)

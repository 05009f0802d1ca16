"""`steerbench paper` and `report`: the runs in a line, their means, what failed jobs leave."""

from __future__ import annotations

import json
import math
import os
import re
import shutil
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest
from omegaconf import DictConfig

from bench.results import Store
from bench.types import Scene, SteerbenchError, Unavailable
from reports.runs import Run, load
from sweeps import configured, execute
from sweeps.commands import paper
from sweeps.commands.paper import gather, newest
from sweeps.measurement import Job, described
from sweeps.plan import DataSet, Planned, chosen, plan
from tests.sweeps.conftest import HERE
from tests.sweeps.test_plan import blender

TABLE3, TABLE5 = (
    replace(table, curve=False, beyond=None)
    for table in chosen(None, [])
    if table.name in ("table3", "table5")
)


@pytest.fixture
def measured(
    store: Store, stored_run: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> list[DictConfig]:
    """Every job but that of L = 3 leaves a run of known figures; the configurations it was asked
    for."""
    asked: list[DictConfig] = []

    def obtain(jobs: list[Job]) -> tuple[list[str], bool]:
        (config,) = [job.config for job in jobs]
        asked.append(config)
        if config.method.model.frames == 3:
            raise SteerbenchError("no room\nfor L = 3")
        return [put(store, stored_run, config)], True

    monkeypatch.setattr(execute, "obtain", obtain)
    monkeypatch.chdir(tmp_path)
    return asked


def put(store: Store, source: str, config: DictConfig) -> str:
    """A copy of the run `source` as that of `config`."""
    parts = {"config": described(config)}
    key = store.key(parts)
    if store.find(key) is None:
        folder = shutil.copytree(store.folder / source, store.folder / key)
        for file in ("rows.csv", "record.json"):
            text = (folder / file).read_text().replace(source, key)
            (folder / file).write_text(text)
        record = json.loads((folder / "record.json").read_text()) | {"made_of": parts}
        (folder / "record.json").write_text(json.dumps(record))
    return key


def labels(page: Path) -> list[str]:
    """The lines of Table 3 on a page."""
    lines = [line for line in page.read_text().splitlines() if line.startswith("| L = ")]
    return [line.split("|")[1].strip() for line in lines]


def test_a_job_that_fails_stands_in_its_line_and_the_others_run(steerbench, measured, store):
    outcome = steerbench("paper", "--table", "table3", "seed=0", f"outputs={store.folder.parent}")
    assert outcome.status == 1
    assert len(measured) == 4 * (1 + 3)  # lines; thrice each for their curves
    assert "failed: table3: L = 3, seed 0: no room" in outcome.err
    assert "about 0:00:0" in outcome.err
    page = Path(re.search(r"report: (.*)", outcome.err)[1])
    assert labels(page) == ["L = 0", "L = 1", "L = 2", "L = 3: failed: no room for L = 3"]
    assert "/ 33.14 /" in page.read_text()


def test_the_jobs_go_where_hydras_launcher_puts_them(steerbench, measured, launched, store):
    words = ("seed=0", f"outputs={store.folder.parent}")
    assert steerbench("paper", "--table", "table5", *words).status == 0
    assert launched == [len(measured)]


def test_what_cannot_run_here_says_so_in_its_line_and_is_no_failure(steerbench, store, monkeypatch):
    def obtain(*_: object) -> None:
        raise Unavailable("no bfloat16 on this CPU")

    monkeypatch.setattr(execute, "obtain", obtain)
    outcome = steerbench("paper", "--table", "table3", "seed=0", f"outputs={store.folder.parent}")
    assert outcome.status == 0
    page = Path(re.search(r"report: (.*)", outcome.err)[1])
    assert labels(page)[0] == "L = 0: failed: no bfloat16 on this CPU"


def test_a_report_has_what_is_there_and_measures_nothing(steerbench, measured, store, stored_run):
    jobs = plan(TABLE3, [f"outputs={store.folder.parent}", "seed=0"])
    put(store, stored_run, jobs[1].config)
    jobs[2].keep_failure("killed")
    outcome = steerbench("report", "--table", "table3", "seed=0", f"outputs={store.folder.parent}")
    assert (outcome.status, measured) == (0, [])
    page = Path(re.search(r"report: (.*)", outcome.err)[1])
    missing = "not measured yet"
    assert labels(page) == [
        f"L = 0: {missing}",
        "L = 1",
        "L = 2: failed: killed",
        f"L = 3: {missing}",
    ]
    written = page.with_suffix(".html").read_text()
    assert ">L = 1</a></td>" in written
    assert not re.search(r'src="(?!data:)', written)


def test_a_check_names_the_broken_rows_of_the_store(steerbench, measured, store, stored_run):
    outputs = f"outputs={store.folder.parent}"
    key = put(store, stored_run, plan(TABLE3, [outputs, "seed=0"])[0].config)
    rows = store.folder / key / "rows.csv"
    table = pd.read_csv(rows)
    named = table["metric"].str.startswith("stage_ms.") & (table["metric"] != "stage_ms.other")
    found = []
    for outside_ms in (0.0, 10.0):
        frame_ms = table.loc[named, "value"].sum() + outside_ms
        table.loc[table["metric"] == "frame_ms", "value"] = frame_ms
        table.to_csv(rows, index=False)
        found.append(steerbench("report", "--check", outputs))
    assert [outcome.status for outcome in found] == [0, 1]
    assert key in found[1].out


def test_the_frames_of_runs_that_are_not_on_a_page_are_not_read(steerbench, store, stored_run):
    outputs = f"outputs={store.folder.parent}"
    key = put(store, stored_run, plan(TABLE3, [outputs, "seed=0"])[0].config)
    for run in (stored_run, key):
        (store.folder / run / "frames.csv").unlink()
    checked = steerbench("report", "--check", outputs)
    assert "of 1 runs look broken" in checked.out
    assert steerbench("report", "--table", "table3", "seed=1", outputs).status == 0


def test_the_page_goes_where_asked_and_tables_to_stdout(steerbench, measured, store, tmp_path):
    folder = tmp_path / "there"
    outputs = f"outputs={store.folder.parent}"
    words = ("--table", "table5", "--report", str(folder), "--format", "latex")
    outcome = steerbench("paper", *words, outputs)
    assert outcome.status == 0
    assert r"\label{tab:table5}" in outcome.out
    assert "## Table 5: Joint training" in (folder / "report.md").read_text()


# Which run of the store a line shows: of the same settings, and of the very scene


def job(folder: Path) -> Planned:
    return plan(TABLE5, ["scene=blender", f"scene.path={folder}", "seed=0"])[0]


def shown(store: Store, folder: Path) -> list[str]:
    """Digests of the scenes of the runs in the line of the job that is asked for at `folder`."""
    ((line,),) = gather([job(folder)], newest(store)).values()
    return [run.record["scene"]["digest"] for run in line.runs]


@pytest.fixture
def scenes(store: Store, stored_run: str, tmp_path: Path) -> Store:
    """A store with the job measured in a/mic and then in b/mic, scenes that differ."""
    for number, name in enumerate("ab"):
        key = f"{number}{stored_run[1:]}"
        folder = shutil.copytree(store.folder / stored_run, store.folder / key)
        path = tmp_path / name / "mic"
        path.mkdir(parents=True)
        record = json.loads((folder / "record.json").read_text())
        record["made_of"] = {"config": described(job(path).config)}
        record["scene"]["digest"], record["scene_path"] = name, str(path)
        (folder / "record.json").write_text(json.dumps(record))
        rows = (folder / "rows.csv").read_text().replace(stored_run, key)
        (folder / "rows.csv").write_text(rows)
        os.utime(folder, (number, number))
    return store


@pytest.fixture
def content(monkeypatch: pytest.MonkeyPatch, tiny_scene: Scene) -> Callable[[str], None]:
    """Says what the digest of a scene is that is loaded; none may be loaded before that."""

    def none(*contents: object) -> Scene:
        raise AssertionError(f"loads {contents}")

    monkeypatch.setattr(configured, "_scene", none)
    return lambda digest: monkeypatch.setattr(
        configured, "_scene", lambda *contents: replace(tiny_scene, digest=digest)
    )


def test_of_folders_with_one_name_each_shows_its_own(scenes, tmp_path, content):
    content("a")
    assert shown(scenes, tmp_path / "a" / "mic") == ["a"]
    content("b")
    assert shown(scenes, tmp_path / "b" / "mic") == ["b"]


def test_a_scene_that_lies_where_it_was_measured_is_not_loaded(scenes, tmp_path, content):
    assert shown(scenes, tmp_path / "b" / "mic") == ["b"]


@pytest.mark.parametrize(("digest", "found"), [("a", ["a"]), ("c", [])])
def test_a_scene_elsewhere_is_known_by_its_content(scenes, tmp_path, content, digest, found):
    (tmp_path / "c" / "mic").mkdir(parents=True)
    content(digest)
    assert shown(scenes, tmp_path / "c" / "mic") == found


def test_of_a_scene_that_is_not_here_the_last_run_is_shown(scenes, tmp_path, content):
    assert shown(scenes, tmp_path / "gone" / "mic") == ["b"]


def test_a_failure_stands_beside_what_was_measured_before(scenes, tmp_path):
    asked = job(tmp_path / "b" / "mic")
    asked.keep_failure("no such folder")
    ((line,),) = gather([asked], newest(scenes)).values()
    assert len(line.runs) == 1
    assert line.gaps == ["failed when it was tried again: no such folder"]


# Means over the scenes of a data set


@pytest.fixture
def psnr(store: Store, stored_run: str, monkeypatch: pytest.MonkeyPatch, elsewhere: None):
    """Gathers lines of Table 5 from the PSNR of each line, scene and seed that was measured."""
    (source,) = load(store, {stored_run: "run"})
    monkeypatch.setattr(paper, "of_scene", lambda run, config: True)

    def lines(found: Mapping[tuple[int, str, int], float], scenes: str, seeds: str):
        data = DataSet("blender", {name: Path("/data") / name for name in scenes}, {})
        jobs = plan(TABLE5, [f"seed={seeds}"], data)
        labels = [line.label for line in TABLE5.lines]
        runs = {}
        for job in jobs:
            place = (labels.index(job.line), job.scene, job.config.seed)
            if place in found:
                runs[job.key] = [run_of(source, job, found[place])]
        (of_table,) = gather(jobs, runs).values()
        return of_table

    return lines


def run_of(source: Run, job: Planned, psnr: float) -> Run:
    """A run of the scene and seed of `job` with this PSNR."""
    rows = source.rows.assign(scene=job.scene, seed=job.config.seed)
    rows.loc[rows["metric"] == "psnr", "value"] = psnr
    return replace(source, key=job.key[:16], rows=rows)


def test_a_figure_is_the_mean_over_seeds_of_means_over_scenes(psnr):
    found = {(0, "a", 0): 30.0, (0, "b", 0): 20.0, (0, "a", 1): 32.0, (0, "b", 1): 22.0}
    line, _ = psnr(found, "ab", "0,1")
    assert [run.values["psnr"] for run in line.runs] == [25.0, 27.0]
    assert line.mean("psnr") == 26.0
    # Of two means that are 2 apart, not of four runs: t(0.975, 1) * sqrt(2) / sqrt(2).
    assert line.half("psnr") == pytest.approx(12.706, abs=1e-3)
    assert [run.facts["seed"] for run in line.runs] == [0, 1]
    assert {run.facts["scene"] for run in line.runs} == {"mean of a, b"}
    assert len(line.measured) == 4


def test_means_are_over_the_scenes_that_all_lines_have(psnr):
    found = {(0, "a", 0): 30.0, (0, "b", 0): 20.0, (0, "c", 0): 10.0, (1, "a", 0): 31.0}
    found[1, "c", 0] = 11.0
    one, other = psnr(found, "abc", "0")
    assert (one.mean("psnr"), other.mean("psnr")) == (20.0, 21.0)
    assert (one.gaps, other.gaps) == ([], ["b not measured yet"])
    assert list(one.by_scene) == ["a", "c", "b"]
    assert one.runs[0].conditions == other.runs[0].conditions


def test_a_line_of_which_nothing_was_measured_takes_no_scene_away(psnr):
    one, other = psnr({(0, "a", 0): 30.0, (0, "b", 0): 20.0}, "ab", "0")
    assert one.mean("psnr") == 25.0
    assert (list(other.runs), other.gaps) == ([], ["not measured yet"])


def test_lines_without_a_common_scene_have_no_mean(psnr):
    one, other = psnr({(0, "a", 0): 30.0, (1, "b", 0): 20.0}, "ab", "0")
    assert one.mean("psnr") is None
    assert one.gaps == ["b not measured yet", "no scene that all lines have"]
    assert other.mean("psnr") is None


def test_a_seed_without_all_scenes_is_left_out_and_named(psnr):
    found = {(0, "a", 0): 30.0, (0, "b", 0): 20.0, (0, "a", 1): 99.0}
    line, _ = psnr(found, "ab", "0,1")
    assert line.mean("psnr") == 25.0
    assert line.gaps == ["seed 1 b not measured yet"]


EXPERIMENT = """\
# @package _global_
# Two greys.
defaults:
  - override /method: grey
hydra:
  sweeper:
    params:
      method: grey,dark
table:
  title: Two greys
  published_on: paper
  metrics: [psnr]
  scenes: [psnr]
  lines:
    - {label: a grey, job: {}, published: [1.0]}
    - {label: a dark one, job: {method: dark}}
  rising:
    psnr: [a dark one, a grey]
"""


def test_the_page_of_a_data_set_has_means_scenes_and_gaps(steerbench, tmp_path, monkeypatch):
    data = tmp_path / "data"
    values = {"chair": 255, "mic": 204}
    for name, value in values.items():
        blender(data / name, value)
    blender(data / "ship", pictures=False)
    tables = tmp_path / "configs" / "experiment"
    tables.mkdir(parents=True)
    (tables / "table9.yaml").write_text(EXPERIMENT)
    monkeypatch.setattr("sweeps.plan.TABLES", tables)
    folders = [f"--config-dir={folder / 'configs'}" for folder in (HERE, tmp_path)]
    words = [f"data={data}", "budget=none", "protocol=quick", "device=cpu"]
    outcome = steerbench("paper", *folders, *words, "seed=0,1")
    assert outcome.status == 0, outcome.err
    assert "missing: ship: no pictures" in outcome.err
    assert "4 of 8" in outcome.err
    page = Path(re.search(r"report: (.*)", outcome.err)[1]).read_text()
    assert "- missing: ship: no pictures" in page
    assert "scene mean of chair, mic" in page
    # Pictures are rounded to 8 bit: 0.5 is 128 of 255, 0.25 is 64.
    grey, dark = (
        [-20 * math.log10((value - level) / 255) for value in values.values()]
        for level in (128, 64)
    )
    mean = f"{sum(grey) / 2:.2f}"
    assert f"| a grey | **{mean}** / 1.00 / " in page
    assert f"| a dark one | {sum(dark) / 2:.2f} / – |" in page
    assert "### Each scene" in page
    for place, scene in enumerate(values):
        assert f"| {scene}: a grey | {grey[place]:.2f} |" in page
        assert f"| {scene}: a dark one | {dark[place]:.2f} |" in page
    assert "| PSNR, dB: a dark one < a grey |" in page
    assert "2 seeds" in page
    again = steerbench("report", *folders, *words, "seed=0,1")
    assert f"| a grey | **{mean}** / 1.00 / " in (tmp_path / "outputs/paper/report.md").read_text()
    assert again.status == 0

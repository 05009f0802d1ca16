"""Tables over the scenes of a data set: which scenes there are, their jobs, their means."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from bench.errors import SteerbenchError
from bench.results import Store
from reports.runs import Run, load
from sweeps import gather
from sweeps.commands.paper import data_set
from sweeps.data_sets import DataSet, find
from sweeps.identity import described
from sweeps.overrides import composed, setting
from sweeps.plan import Planned, chosen, plan

(TABLE,) = (replace(table, curve=False) for table in chosen(None, []) if table.name == "table5")
HERE = Path(__file__).parent
POSE = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]]


def blender(folder: Path, value: int = 255, pictures: bool = True) -> Path:
    """A scene in the layout of NeRF-Synthetic: two pictures of 16 x 16 of one value a split."""
    for split in ("train", "test"):
        (folder / split).mkdir(parents=True)
        names = [f"./{split}/r_{number}" for number in range(2)]
        frames = [{"file_path": name, "transform_matrix": POSE} for name in names]
        record = {"camera_angle_x": 0.7, "frames": frames}
        (folder / f"transforms_{split}.json").write_text(json.dumps(record))
        for name in names if pictures else ():
            picture = np.full((16, 16, 3), value, np.uint8)
            Image.fromarray(picture).save(folder / f"{name}.png")
    return folder


def nsvf(folder: Path, pictures: bool = True) -> Path:
    """A scene in NSVF's layout, as far as its names show."""
    for name in ("rgb", "pose"):
        (folder / name).mkdir(parents=True)
    (folder / "bbox.txt").touch()
    if pictures:
        (folder / "rgb" / "0_00000.png").touch()
    return folder


# Which scenes there are


def test_of_nerf_synthetic_what_is_there_is_found_and_the_rest_is_named(tmp_path):
    for name in ("mic", "lego"):
        blender(tmp_path / name)
    blender(tmp_path / "chair", pictures=False)
    (tmp_path / "lego" / "test" / "r_1.png").unlink()
    (tmp_path / "drums").mkdir()
    found = find(str(tmp_path))
    assert (found.layout, list(found.scenes)) == ("blender", ["mic"])
    assert found.missing == {
        "chair": "no pictures",
        "drums": "no transforms_train.json or bbox.txt",
        "ficus": "no folder",
        "hotdog": "no folder",
        "lego": "1 of 4 pictures are not there",
        "materials": "no folder",
        "ship": "no folder",
    }


def test_of_tanks_and_temples_too(tmp_path):
    for name in ("Barn", "Truck"):
        nsvf(tmp_path / name)
    nsvf(tmp_path / "Family", pictures=False)
    found = find(str(tmp_path))
    assert (found.layout, list(found.scenes)) == ("nsvf", ["Barn", "Truck"])
    assert set(found.missing) == {"Caterpillar", "Family", "Ignatius"}


def test_scenes_of_ones_own_miss_nothing(tmp_path):
    blender(tmp_path / "teapot")
    assert find(str(tmp_path)).missing == {}


def test_scenes_of_two_layouts_have_no_mean(tmp_path):
    blender(tmp_path / "mic")
    nsvf(tmp_path / "Barn")
    with pytest.raises(SteerbenchError, match="scenes of both: Barn, mic"):
        find(str(tmp_path))


@pytest.mark.parametrize("make", [lambda path: None, blender])
def test_a_folder_without_scenes_is_refused(tmp_path, make):
    make(tmp_path)
    with pytest.raises(SteerbenchError, match=r"got none.*scene\.path"):
        find(str(tmp_path))


# Which word names them


@pytest.mark.parametrize("word", ["scene=totem", "scene.path=elsewhere", "++scene.path=elsewhere"])
def test_a_scene_beside_a_data_set_is_refused(tmp_path, word):
    blender(tmp_path / "mic")
    with pytest.raises(SteerbenchError, match="expected one of them"):
        data_set([word, f"data={tmp_path}"])
    assert data_set([word]) == ([word], None)


def test_other_settings_of_the_scenes_go_through(tmp_path):
    blender(tmp_path / "mic")
    words, data = data_set(["scene.downscale=4", f"data={tmp_path}", "budget=tiny"])
    assert words == ["scene.downscale=4", "budget=tiny"]
    (scale,) = {job.config.scene.downscale for job in plan(TABLE, words, data)}
    assert scale == 4


@pytest.mark.parametrize("text", ["/data/chair", "/a b,c (d)/it's", "/x=1/${y}#2", "~/Jürgen"])
def test_any_folder_can_be_named_in_a_command(text):
    config = composed(["scene=blender", setting("scene.path", text)])
    assert config.scene._get_node("path")._value() == text


# Their jobs


def test_every_scene_is_a_job_of_its_own_and_a_command_that_makes_it(tmp_path):
    for name in ("mic", "chair"):
        blender(tmp_path / "my data" / name)
    data = find(str(tmp_path / "my data"))
    jobs = plan(replace(TABLE, beyond=None), ["budget=tiny", "seed=0,1"], data)
    cells = [(job.scene, job.config.seed) for job in jobs]
    assert cells == 2 * [("chair", 0), ("mic", 0), ("chair", 1), ("mic", 1)]
    assert len({job.key for job in jobs}) == len(jobs)
    for job in jobs:
        again = composed([text for text in job.command[2:] if text != "hydra.mode=RUN"])
        assert described(again) == described(job.config)
        assert again.scene.path == str(tmp_path / "my data" / job.scene)
    assert jobs[0].name.endswith(", chair, seed 0")


# Their means


@pytest.fixture
def psnr(store: Store, stored_run: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """Gathers lines of Table 5 from the PSNR of each line, scene and seed that was measured."""
    (source,) = load(store, {stored_run: "run"})
    monkeypatch.setattr(gather, "of_scene", lambda run, config: True)

    def lines(found: Mapping[tuple[int, str, int], float], scenes: str, seeds: str):
        data = DataSet("blender", {name: Path("/data") / name for name in scenes}, {})
        jobs = plan(replace(TABLE, beyond=None), [f"seed={seeds}"], data)
        labels = [line.label for line in TABLE.lines]
        runs = {}
        for job in jobs:
            place = (labels.index(job.line), job.scene, job.config.seed)
            if place in found:
                runs[job.key] = [run_of(source, job, found[place])]
        (of_table,) = gather.gather(jobs, runs, tmp_path).values()
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


# All of it, with a method that trains nothing

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

"""`steerbench paper` and `report`: the runs in a line, their means, what failed jobs leave."""

import re
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import pytest
from omegaconf import DictConfig

from bench.results import Store
from bench.types import SteerbenchError, Unavailable
from reports.claims import gap
from reports.runs import load_runs
from sweeps import configured, measurement
from sweeps.commands import paper
from sweeps.commands.paper import gather
from sweeps.data_sets import DataSet
from sweeps.measurement import Job, JobFailed, described
from sweeps.plan import Planned, plan
from sweeps.versions import by_job
from tests.reports.conftest import changed, copied, rewrite
from tests.sweeps.conftest import CONFIGS
from tests.sweeps.test_plan import TABLES, blender

TABLE3, TABLE5 = (TABLES[name] for name in ("table3", "table5"))


@pytest.fixture
def outputs(store) -> str:
    """The word for the folder of the store."""
    return f"outputs={store.folder.parent}"


@pytest.fixture
def measured(store, stored_run, tmp_path, monkeypatch) -> list[DictConfig]:
    """Every job but that of L = 3 leaves a run of known figures; the configurations it was asked
    for."""
    asked = []

    def obtained(jobs, log):
        for job in jobs:
            if job.config.method.model.frames == 3:
                asked.append(job.config)
                error = SteerbenchError("no room\nfor L = 3")
                raise error if len(jobs) == 1 else JobFailed(job) from error
        asked.extend(job.config for job in jobs)
        return [put(store, stored_run, job) for job in jobs], True

    monkeypatch.setattr(measurement, "_obtained", obtained)
    monkeypatch.chdir(tmp_path)
    return asked


def put(store: Store, source: str, job: Job, key: str = "") -> str:
    """A copy of the run `source` as that of `job`."""
    parts = {"config": described(job.config), "turns": job.turns}
    key = key or store.key(parts)
    if store.find(key) is None:
        copied(store, source, key)
        rewrite(store, key, made_of=parts)
    return key


def labels(page: Path) -> list[str]:
    table = page.read_text().partition("| here (paper) |")[2].partition("\n\n")[0]
    lines = [line for line in table.splitlines() if line.startswith("| L = ")]
    return [line.split("|")[1].strip() for line in lines]


def test_a_job_that_fails_stands_in_its_line_and_the_others_run(steerbench, measured, outputs):
    outcome = steerbench("table", "table3", "seed=0", outputs)
    assert outcome.status == 1
    assert len(measured) == 4
    assert "failed: table3: L = 3, seed 0: no room" in outcome.err
    page = Path(re.search(r"report: (.*)", outcome.err)[1])
    assert labels(page) == ["L = 0", "L = 1", "L = 2", "L = 3: failed: no room for L = 3"]
    assert "(+0.20) |" in page.read_text()  # from L = 0 to 2


def test_the_jobs_go_where_hydras_launcher_puts_them(steerbench, measured, launched, outputs):
    assert steerbench("table", "table5", "seed=0", outputs).status == 0
    assert launched == [len(measured)]


def test_what_cannot_run_here_says_so_and_does_not_fail(steerbench, monkeypatch, outputs):
    cause = Unavailable("no bfloat16 on this CPU")
    monkeypatch.setattr(measurement, "_obtained", Mock(side_effect=cause))
    outcome = steerbench("table", "table3", "seed=0", outputs).ok()
    page = Path(re.search(r"report: (.*)", outcome.err)[1])
    assert labels(page)[0] == "L = 0: failed: no bfloat16 on this CPU"


def test_a_report_has_what_is_there_alone(steerbench, measured, outputs, store, stored_run):
    jobs = plan(TABLE3, [outputs, "seed=0"])
    put(store, stored_run, jobs[1])
    jobs[2].keep_failure(SteerbenchError("killed"))
    outcome = steerbench("report", "--table", "table3", "seed=0", outputs)
    assert (outcome.status, measured) == (0, [])
    page = Path(re.search(r"report: (.*)", outcome.err)[1])
    last = "L = 3: not measured yet"
    assert labels(page) == ["L = 0: not measured yet", "L = 1", "L = 2: failed: killed", last]
    written = page.with_suffix(".html").read_text()
    assert ">L = 1</a></td>" in written
    assert not re.search(r'src="(?!data:)', written)


def test_frames_of_runs_that_are_not_on_a_page_are_not_read(steerbench, outputs, store, stored_run):
    key = put(store, stored_run, plan(TABLE3, [outputs, "seed=0"])[0])
    for run in (stored_run, key):
        (store.folder / run / "frames.csv").unlink()
    assert steerbench("report", "--table", "table3", "seed=1", outputs).status == 0


def test_the_page_goes_where_asked_and_tables_to_stdout(steerbench, measured, outputs, tmp_path):
    folder = tmp_path / "there"
    words = ("--report", str(folder), "--format", "latex")
    outcome = steerbench("table", "table5", *words, outputs).ok()
    assert r"\label{tab:table5}" in outcome.out
    assert "## Table 5: Joint training" in (folder / "report.md").read_text()


# Which run of the store a line shows: of the same settings, and of the very scene


def job(folder: Path) -> Planned:
    return plan(TABLE5, ["scene=blender", f"scene.path={folder}", "seed=0"])[0]


@pytest.fixture
def scenes(store, stored_run, tmp_path) -> Store:
    """A store with the job measured in a/mic and then in b/mic, scenes that differ."""
    for number, name in enumerate("ab"):
        path = tmp_path / name / "mic"
        path.mkdir(parents=True)
        key = put(store, stored_run, job(path), f"{number}{stored_run[1:]}")
        rewrite(store, key, scene={"digest": name}, scene_path=str(path), stored=number + 1.0)
    return store


@pytest.mark.parametrize(
    ("folder", "digest", "found"),
    [
        ("a", "a", ["a"]),
        ("b", None, ["b"]),  # lies where it was measured: it is not loaded
        ("c", "a", ["a"]),  # elsewhere: it is known by its content
        ("c", "c", []),
        ("gone", None, ["b"]),  # not here: the last run is shown
    ],
)
def test_folders_show_their_own(scenes, tmp_path, monkeypatch, tiny_scene, folder, digest, found):
    def loaded(*contents):
        assert digest, f"loads {contents}"
        file = Path(__file__)
        stamps = configured._stamps([file])
        return configured._Read(replace(tiny_scene, digest=digest), [file], stamps)

    monkeypatch.setattr(configured, "_scene", loaded)
    (tmp_path / "c/mic").mkdir(parents=True)
    (line,) = gather([job(tmp_path / folder / "mic")], by_job(scenes, print)).values()
    assert [run.record["scene"]["digest"] for run in line.runs] == found


@pytest.mark.parametrize(
    ("error", "kept", "said"),
    [
        (SteerbenchError("no such folder"), 0, "failed: no such folder"),
        (Unavailable("no GPU"), 1, "cannot run here: no GPU"),
    ],
)
def test_no_earlier_run_stands_for_what_fails(scenes, tmp_path, elsewhere, error, kept, said):
    asked = job(tmp_path / "b/mic")
    asked.keep_failure(error)
    (line,) = gather([asked], by_job(scenes, print)).values()
    assert len(line.runs) == kept
    assert line.gaps == [said]


# Means over the scenes of a data set


@pytest.fixture
def psnr(store, stored_run, monkeypatch, elsewhere):
    """Gathers lines of Table 5 from the PSNR of each line, scene and seed that was measured."""
    (source,) = load_runs(store, [stored_run])
    monkeypatch.setattr(paper, "of_scene", lambda run, config: True)

    def lines(found, scenes, seeds):
        data = DataSet("blender", {name: Path("/data") / name for name in scenes}, {})
        jobs = plan(TABLE5, [f"seed={seeds}"], data)
        keys = list(TABLE5.lines)
        runs = {}
        for job in jobs:
            place = (keys.index(job.place.line), job.scene, job.config.seed)
            if place in found:
                facts = {"scene": job.scene, "seed": job.config.seed}
                run = changed(source, {"psnr": found[place]}, **facts)
                runs[job.key] = [replace(run, key=job.key[:16])]
        return gather(jobs, runs).values()

    return lines


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
    assert gap("psnr", one, other).by == 1.0  # of the same scenes
    assert one.runs[0].conditions == other.runs[0].conditions


A_AND_B = {(0, "a", 0): 30.0, (0, "b", 0): 20.0}


@pytest.mark.parametrize(
    ("found", "seeds", "means", "gaps"),
    [
        (A_AND_B, "0", [25.0, None], [[], ["not measured yet"]]),  # takes no scene away
        (
            {(0, "a", 0): 30.0, (1, "b", 0): 20.0},
            "0",
            [None, None],
            [[f"{x} not measured yet", "no scene that all lines have"] for x in "ba"],
        ),
        (
            {**A_AND_B, (0, "a", 1): 99.0},
            "0,1",
            [25.0, None],
            [["seed 1 b not measured yet"], ["not measured yet"]],
        ),
    ],
)
def test_what_is_left_out_of_a_mean_is_named(psnr, found, seeds, means, gaps):
    lines = psnr(found, "ab", seeds)
    assert [line.mean("psnr") for line in lines] == means
    assert [line.gaps for line in lines] == gaps


# All of it, with a method that trains nothing


def test_the_page_of_a_data_set_has_means_scenes_and_gaps(steerbench, tmp_path):
    data = tmp_path / "data"
    for name, value in {"chair": 255, "mic": 204}.items():
        blender(data / name, value)
    blender(data / "ship", pictures=False)
    words = [CONFIGS, f"data={data}", "device=cpu", "seed=0,1"]
    outcome = steerbench("table", "table9", *words).ok()
    assert "missing: ship: no pictures" in outcome.err
    assert "4 of 8" in outcome.err
    page = tmp_path / "outputs/table9/report.md"
    # 0.5 is rounded to 128 of 255, 0.25 to 64: on 255 and on 204, PSNR = 20 log10(255 / error).
    for said in (
        *("- missing: ship: no pictures", "scene mean of chair, mic", "### Each scene"),
        *("| chair: a grey | 6.05 |", "| mic: a grey | 10.51 |", "| a grey | **8.28** |"),
        *("| chair: a dark one | 2.51 |", "| mic: a dark one | 5.21 |", "| a dark one | 3.86 |"),
        *("| a dark one | -4.43 (-0.50) |", "2 scenes × 2 seeds"),
        "| Table 9, PSNR, dB: a dark one < a grey | +0.50 | +4.43 |",
    ):
        assert said in page.read_text()
    page.unlink()
    steerbench("report", "--table", "table9", *words).ok()
    assert "| a grey | **8.28** |" in page.read_text()

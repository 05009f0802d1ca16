"""`steerbench paper`: its plan, its page, what a failed job leaves behind."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from functools import cache
from pathlib import Path

import pandas as pd
import pytest
from omegaconf import DictConfig

from bench.results import Store
from bench.types import SteerbenchError, Unavailable
from sweeps import failures, jobs
from sweeps.identity import described
from sweeps.measurement import Group, Obtained
from sweeps.overrides import composed
from sweeps.plan import Planned, chosen, plan

CURVED = {table.name: table for table in chosen(None, [])}
TABLES = {name: replace(table, curve=False) for name, table in CURVED.items()}
"""Their lines alone."""


@cache
def with_one_seed(name: str) -> tuple[Planned, ...]:
    """The jobs of the lines of a table; composing them takes seconds."""
    return tuple(plan(TABLES[name], ["seed=0"]))


@pytest.mark.parametrize("name", TABLES)
def test_every_line_that_can_be_measured_has_its_job(name):
    jobs = with_one_seed(name)
    lines = [line.label for block in TABLES[name].blocks for line in block.lines]
    assert sorted(job.line for job in jobs) == sorted(lines)
    assert len({job.key for job in jobs}) == len(lines)


def test_a_curve_has_the_lines_of_the_papers_method_at_several_shares_of_one_training():
    table = CURVED["table5"]
    lines, jobs = (plan(one, ["budget=demo"]) for one in (TABLES["table5"], table))
    marks = [job for job in jobs if "after" in job.line]
    assert [job.key for job in jobs if job not in marks] == [job.key for job in lines]
    assert len(marks) == 2 * 3  # lines, shares; of the first seed
    for job in marks:
        label, _, share = job.line.partition(", after ")
        (whole,) = (
            one for one in lines if one.line == label and one.config.seed == job.config.seed
        )
        one, other = described(job.config), described(whole.config)
        assert (one["method"].pop("after"), other["method"].pop("after")) == (float(share), 1)
        scored = one.pop("protocol"), other.pop("protocol")
        assert [protocol["lpips"] for protocol in scored] == [[], ["alex", "vgg"]]
        assert one == other


@pytest.mark.parametrize(
    ("words", "seeds", "of_ours"),
    [
        *(([f"budget={name}"], 1, [0]) for name in ("tiny", "full")),
        *(([f"budget={name}"], 3, [0]) for name in ("demo", "small")),
        (["budget=paper"], 3, []),
        (["budget=demo", "tables.seeds=2"], 2, [0]),
        (["budget=demo", "seed=7"], [7], [7]),
        (["budget=demo", "seed=1,2"], [1, 2], [1, 2]),
    ],
)
def test_only_the_papers_method_is_repeated_unless_seeds_are_asked_for(words, seeds, of_ours):
    found: dict[str, list[int]] = {"steernerf_lean": []}
    for job in plan(CURVED["table5"], words):
        if job.block == "curves":
            continue
        found.setdefault(job.config.method.name, []).append(job.config.seed)
    expected = list(range(seeds)) if isinstance(seeds, int) else seeds
    assert found == {"steernerf": 2 * expected, "steernerf_lean": 2 * of_ours}


def test_only_the_table_of_times_is_measured_in_turns():
    """The lines of a method with one seed together."""
    for name in TABLES:
        jobs = with_one_seed(name)
        turns = {job.turns for job in jobs}
        assert (turns == {""}) == (name != "table2")
        for turn in turns - {""}:
            together = [job for job in jobs if job.turns == turn]
            assert len(together) == 2
            assert len({(job.config.method.name, job.config.seed) for job in together}) == 1


def test_settings_hold_for_every_job():
    for job in plan(TABLES["table3"], ["budget=tiny", "seed=3"]):
        assert job.config.budget.name == "tiny"
        assert job.config.seed == 3
        assert job.line == f"L = {job.config.method.model.frames}"
        assert job.config.trajectory._target_ == "bench.trajectories.orbit"


@pytest.mark.parametrize("name", [name for name in TABLES if name != "table3"])
def test_a_table_is_of_the_papers_method_and_then_of_ours(name):
    configs = [job.config for job in with_one_seed(name)]
    methods = [config.method.name for config in configs if "engine" in config.method]
    half = len(methods) // 2
    assert methods == ["steernerf"] * half + ["steernerf_lean"] * half


def test_the_lines_of_table_3_differ_in_l_alone():
    settings = [described(job.config) for job in with_one_seed("table3")]
    assert len(settings) == 4
    for number, setting in enumerate(settings):
        assert setting["method"]["rendering"]["range"]["mode"] == "off"
        of_training = setting["method"]["joint"]["motion"]  # has exactly L frames
        nodes = (
            (setting["method"]["model"], "frames"),
            (of_training, "length"),
            (of_training, "least"),
        )
        assert [node.pop(name) for node, name in nodes] == [number] * 3
    assert all(setting == settings[0] for setting in settings)


def test_every_seed_is_a_job_of_its_own_and_a_command_that_makes_it():
    jobs = plan(replace(TABLES["table5"], beyond=None), ["budget=tiny", "seed=0,2"])
    assert [(job.line[:4], job.config.seed) for job in jobs] == [
        ("with", 0),
        ("with", 2),
        ("with", 0),
        ("with", 2),
    ]
    for job in jobs:
        again = composed([text for text in job.command[2:] if text != "hydra.mode=RUN"])
        assert described(again) == described(job.config)


def test_tables_share_the_run_that_they_have_in_common():
    """But for the table of times: a time in turns is another figure than one alone."""
    lines = [("table3", 2), ("table4", 1), ("table5", 0), ("table2", 0)]
    *jobs, timed = (with_one_seed(name)[place] for name, place in lines)
    assert len({job.key for job in jobs}) == 1
    assert described(timed.config) == described(jobs[0].config)
    assert timed.key != jobs[0].key


@pytest.mark.parametrize(
    ("method", "name", "line"),
    [
        ("ngp", "table1", "Instant-NGP"),
        ("steernerf", "table4", "K = 6"),
        ("steernerf_lean", "table4", "K = 6 (steernerf_lean)"),
        ("steernerf_lean_frozen", "table5", "without joint training (steernerf_lean)"),
        ("steernerf_lean_k3", "table4", "K = 3 (steernerf_lean)"),
    ],
)
def test_what_the_figures_show_is_what_the_tables_measure(method, name, line):
    shown = composed(["+experiment=figures", f"method={method}"])
    (job,) = (job for job in with_one_seed(name) if job.line == line)
    assert described(shown) == described(job.config)


@pytest.mark.parametrize("word", ["tables.seeds=5", "tables.beyond=false"])
def test_what_only_the_tables_read_changes_no_key(word):
    assert described(composed([word])) == described(composed([]))


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("budgt=tiny", "budgt"),
        ("scene=totem,wires", "totem, wires"),
        ("a=b=,", "a=b=,"),
        ("tables.seeds=0", "tables: seeds: expected 1 or more"),
        ("budget.threads=0", "threads: expected 1 or more"),
    ],
)
def test_a_setting_that_cannot_be_had_is_named(override, said):
    with pytest.raises(SteerbenchError, match=said):
        plan(TABLES["table3"], [override])


@pytest.fixture
def measured(
    store: Store, stored_run: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> list[DictConfig]:
    """Every job but that of L = 3 leaves a run of known figures; the configurations it was asked
    for."""
    asked: list[DictConfig] = []

    def obtain(group: Group) -> list[Obtained]:
        (config,) = [job.config for job in group.jobs]
        asked.append(config)
        if config.method.model.frames == 3:
            raise SteerbenchError("no room\nfor L = 3")
        return [Obtained(store, put(store, stored_run, config), measured=True)]

    monkeypatch.setattr(jobs, "obtain", obtain)
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
    def obtain(*_: object) -> list[Obtained]:
        raise Unavailable("no bfloat16 on this CPU")

    monkeypatch.setattr(jobs, "obtain", obtain)
    outcome = steerbench("paper", "--table", "table3", "seed=0", f"outputs={store.folder.parent}")
    assert outcome.status == 0
    page = Path(re.search(r"report: (.*)", outcome.err)[1])
    assert labels(page)[0] == "L = 0: failed: no bfloat16 on this CPU"


def test_a_report_has_what_is_there_and_measures_nothing(steerbench, measured, store, stored_run):
    jobs = plan(TABLES["table3"], [f"outputs={store.folder.parent}", "seed=0"])
    put(store, stored_run, jobs[1].config)
    failures.keep(store.folder.parent, described(jobs[2].config), "killed")
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


def test_a_failure_is_forgotten_once_the_job_succeeds(tmp_path):
    job = {"seed": 1}
    failures.keep(tmp_path, job, "no room")
    assert failures.last(tmp_path, job) == "no room"
    assert failures.last(tmp_path, {"seed": 2}) is None
    failures.forget(tmp_path, job)
    assert failures.last(tmp_path, job) is None


def test_a_check_names_the_broken_rows_of_the_store(steerbench, measured, store, stored_run):
    outputs = f"outputs={store.folder.parent}"
    key = put(store, stored_run, plan(TABLES["table3"], [outputs, "seed=0"])[0].config)
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
    key = put(store, stored_run, plan(TABLES["table3"], [outputs, "seed=0"])[0].config)
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

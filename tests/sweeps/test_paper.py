"""`steerbench paper`: its plan, its page, what a failed job leaves behind."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import pytest
from omegaconf import DictConfig

from bench.results import Store
from bench.types import SteerbenchError
from reports.published import paper_tables
from sweeps import paper
from sweeps.measurement import Obtained

TABLES = {table.name: table for table in paper_tables()}


@pytest.mark.parametrize("name", TABLES)
def test_every_job_of_an_experiment_fills_one_line_and_every_line_has_its_job(name: str) -> None:
    jobs = [dict(job.settings) for job in paper.plan(name, [])]
    lines = [dict(line.job) for line in TABLES[name].lines if line.job is not None]
    assert sorted(map(str, jobs)) == sorted(map(str, lines))


def test_settings_hold_for_every_job() -> None:
    for job in paper.plan("table3", ["budget=tiny", "seed=3"]):
        assert job.config.budget.name == "tiny"
        assert job.config.seed == 3
        assert str(job.config.method.pipeline.frames) == job.settings["method.pipeline.frames"]
        assert job.config.trajectory._target_ == "bench.trajectories.smooth"


def test_a_setting_that_does_not_exist_is_named() -> None:
    with pytest.raises(SteerbenchError, match=r"budgt"):
        paper.plan("table3", ["budgt=tiny"])


@pytest.fixture
def measured(
    store: Store, stored_run: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> list[DictConfig]:
    """Every job but that of L = 3 finds the one run of the store; the configurations it was
    asked for."""
    asked: list[DictConfig] = []

    def obtain(config: DictConfig, command: Sequence[str]) -> Obtained:
        asked.append(config)
        if config.method.pipeline.frames == 3:
            raise SteerbenchError("no room\nfor L = 3")
        return Obtained(store, stored_run, measured=False)

    monkeypatch.setattr(paper, "obtain", obtain)
    monkeypatch.chdir(tmp_path)
    return asked


def test_a_job_that_fails_stands_in_its_line_and_the_others_run(
    steerbench, measured: list[DictConfig], store: Store
) -> None:
    outcome = steerbench("paper", "--table", "table3", f"outputs={store.folder.parent}")
    assert outcome.status == 1
    assert len(measured) == 4
    assert "failed: table3: method.pipeline.frames=3: no room" in outcome.err
    page = Path(re.search(r"report: (.*)", outcome.err)[1]).read_text()
    lines = [line for line in page.splitlines() if line.startswith("| L = ")]
    assert [line.split("|")[1].strip() for line in lines] == [
        "L = 0",
        "L = 1",
        "L = 2",
        "L = 3: failed: no room for L = 3",
    ]
    assert "/ 33.14 /" in lines[2]


def test_the_page_goes_where_it_is_asked_for(
    steerbench, measured: list[DictConfig], store: Store, tmp_path: Path
) -> None:
    folder = tmp_path / "there"
    outputs = f"outputs={store.folder.parent}"
    outcome = steerbench("paper", "--table", "table5", "--report", str(folder), outputs)
    assert outcome.status == 0
    assert "## Table 5: Joint training" in (folder / "report.md").read_text()


def test_a_table_that_does_not_exist_is_refused(steerbench) -> None:
    outcome = steerbench("paper", "--table", "table9")
    assert outcome.status == 2
    assert "table9" in outcome.err
    assert "table6" in outcome.err

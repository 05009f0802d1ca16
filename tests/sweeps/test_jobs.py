"""What jobs leave behind, their labels beside each other, and the message of one that fails."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest

from bench.errors import SteerbenchError
from sweeps import jobs
from sweeps.commands.run import label
from sweeps.jobs import Ended, read
from sweeps.measurement import Group, Job
from sweeps.overrides import composed


def test_jobs_are_read_as_they_were_written_in_the_order_of_the_sweep(tmp_path):
    job = Ended(0, "ngp", "outputs", None, begun=1.0)
    ended = [replace(job, number=number, run=f"run {number}") for number in range(12)]
    for each in reversed(ended):
        each.write(tmp_path)
    assert read(tmp_path) == ended


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["method"], "ngp"),
        (["method", "seed"], "ngp (seed=2)"),
        (["scene.seed", "seed"], "ngp (scene.seed=1, seed=2)"),
        (["scene.seed", "elsewhere"], "ngp (seed=1)"),
    ],
)
def test_a_label_has_method_and_what_varies_by_whole_names_where_ends_are_alike(names, expected):
    words = ("+experiment=demo", "scene.seed=1", "seed=2", "method=ngp")
    assert label("ngp", words, names) == expected


def test_a_failure_that_cannot_be_kept_is_printed_all_the_same(tmp_path, monkeypatch, capsys):
    def obtain(group: Group) -> None:
        raise SteerbenchError("the cause")

    runtime = SimpleNamespace(output_dir=str(tmp_path / "sweep"))
    monkeypatch.setattr(jobs.HydraConfig, "get", lambda: SimpleNamespace(runtime=runtime))
    monkeypatch.setattr(jobs, "obtain", obtain)
    (tmp_path / "outputs").touch()  # no folder can be made there
    job = Job(composed([f"outputs={tmp_path / 'outputs'}"]), [], "a job")
    with pytest.raises(SteerbenchError, match="the cause"):
        jobs.attempt(Group([job]), 1)
    printed = capsys.readouterr().err
    assert "failed: a job: the cause" in printed
    assert "cannot write to" in printed

"""What jobs leave behind, their labels beside each other, and the message of one that fails."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from bench.errors import SteerbenchError
from sweeps import jobs
from sweeps.jobs import Job, read, varying
from sweeps.overrides import composed

JOB = Job(0, "ngp", ("+experiment=demo", "seed=0", "method=ngp"), "outputs", None, begun=1.0)


def test_jobs_are_read_as_they_were_written_in_the_order_of_the_sweep(tmp_path):
    ended = [replace(JOB, number=number, run=f"run {number}") for number in range(12)]
    for job in reversed(ended):
        job.write(tmp_path)
    assert read(tmp_path) == ended


@pytest.mark.parametrize(
    ("others", "label"),
    [
        (["method=nerf", "seed=0"], "ngp"),
        (["seed=1"], "ngp (seed=0)"),
        (["+method.grid.levels=8"], "ngp (seed=0)"),
    ],
)
def test_a_label_has_the_method_and_what_varies(others, label):
    other = replace(JOB, overrides=("+experiment=demo", *others))
    names = varying([JOB, other])
    assert JOB.label(names) == label


def test_settings_that_end_alike_have_their_whole_names():
    job = replace(JOB, overrides=("scene.seed=1", "seed=2"))
    assert job.label(["scene.seed", "seed"]) == "ngp (scene.seed=1, seed=2)"


def test_a_failure_that_cannot_be_kept_is_printed_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def obtain(*_: object) -> None:
        raise SteerbenchError("the cause")

    monkeypatch.setattr(jobs, "obtain_in_turns", obtain)
    (tmp_path / "outputs").touch()  # no folder can be made there
    with pytest.raises(SteerbenchError, match="the cause"):
        jobs.attempt(composed([f"outputs={tmp_path / 'outputs'}"]), [], "a job")
    printed = capsys.readouterr().err
    assert "failed: a job: the cause" in printed
    assert "cannot write to" in printed

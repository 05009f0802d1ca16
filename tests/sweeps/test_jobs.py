"""What jobs leave behind, and what they are called beside each other."""

from __future__ import annotations

from dataclasses import replace

import pytest

from sweeps.jobs import Job, read, varying

JOB = Job(0, "ngp", ("+experiment=demo", "seed=0", "method=ngp"), "outputs", None, begun=1.0)


def test_jobs_are_read_as_they_were_written_in_the_order_of_the_sweep(tmp_path):
    jobs = [replace(JOB, number=number, run=f"run {number}") for number in range(12)]
    for job in reversed(jobs):
        job.write(tmp_path)
    assert read(tmp_path) == jobs


@pytest.mark.parametrize(
    ("others", "label"),
    [
        (["method=nerf", "seed=0"], "ngp"),
        (["seed=1"], "ngp (seed=0)"),
        (["+method.grid.levels=8"], "ngp (seed=0)"),
    ],
)
def test_a_label_tells_the_method_and_what_varies(others, label):
    other = replace(JOB, overrides=("+experiment=demo", *others))
    names = varying([JOB, other])
    assert JOB.label(names) == label


def test_settings_that_end_alike_are_told_by_their_whole_names():
    job = replace(JOB, overrides=("scene.seed=1", "seed=2"))
    assert job.label(["scene.seed", "seed"]) == "ngp (scene.seed=1, seed=2)"

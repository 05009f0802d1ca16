"""A sweep: runs its jobs one by one, and at the end makes one table and one page about all.

Jobs may run in other processes, so they share only the folder of the sweep and the store.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from math import prod
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from bench.results import Store
from reports.comparison import comparison
from reports.page import write_page
from reports.runs import load, over_common_frames
from sweeps import failures
from sweeps.jobs import Job, attempt, read, say, time_left, varying
from sweeps.sweep_callback import SweepCallback
from sweeps.terminal import console, show


def run_job(config: DictConfig, command: Sequence[str]) -> None:
    """Run the current job of a sweep, record how it ended, and print that in one line.

    `command` runs this job alone. Raises what the measurement raises.
    """
    present = HydraConfig.get()
    folder = Path(present.runtime.output_dir)
    job = Job(
        present.job.num,
        present.runtime.choices["method"],
        tuple(present.overrides.task),
        str(config.outputs),
        config.report,
        begun=time.time(),
    )
    try:
        obtained = attempt(config, command, " ".join(job.overrides))
    except Exception as error:
        with failures.printed():
            replace(job, failure=failures.reason(error)).write(folder)
        raise
    replace(job, run=obtained.run, measured=obtained.measured).write(folder)
    swept = [name for name in SweepCallback.sizes if name != "method"]
    say(obtained, job.label(swept), _progress(read(folder)))


def finish(folder: Path) -> None:
    """Print one table of all jobs that have ended, and write the pages that they requested.

    Raises:
        SteerbenchError: a page cannot be written.
    """
    jobs = read(folder)
    for outputs in dict.fromkeys(job.outputs for job in jobs):
        there = [job for job in jobs if job.outputs == outputs]
        names, store = varying(there), Store(Path(outputs))
        _show(store, *_labels(there, names))
        for report in dict.fromkeys(job.report for job in there if job.report):
            runs, failed = _labels([job for job in there if job.report == report], names)
            if runs:
                page = write_page(store, runs, Path(report), failed)
                print(f"report: {page}", file=sys.stderr)


def _progress(ended: Sequence[Job]) -> str:
    """How many jobs are done, and an estimate of the remaining time from the measured ones."""
    total, measured = prod(SweepCallback.sizes.values()), sum(job.measured for job in ended)
    if SweepCallback.folder is None or len(ended) > total:
        return ""
    seconds = time.time() - min(job.begun for job in ended)
    left = time_left(seconds, measured, total - len(ended))
    return f"; {len(ended)} of {total} jobs done{left}"


def _labels(jobs: Sequence[Job], names: Sequence[str]) -> tuple[dict[str, str], dict[str, str]]:
    """Labels of the runs by key, and reasons of failed jobs by label."""
    runs = {job.run: job.label(names) for job in jobs if job.run}
    return runs, {job.label(names): job.failure for job in jobs if job.failure}


def _show(store: Store, labels: dict[str, str], failed: dict[str, str]) -> None:
    """Print the table of all jobs, and why figures are missing."""
    runs = over_common_frames(load(store, labels))
    show(comparison(runs, failed))
    for note in dict.fromkeys(
        f"{metric}: n/a. {why}" for run in runs for metric, why in run.record["missing"].items()
    ):
        console().print(note, markup=False, soft_wrap=True)

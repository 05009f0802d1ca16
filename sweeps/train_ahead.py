"""Trains the models of many jobs in parallel, because small ones gain little from a second core."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Collection, Mapping, Sequence
from concurrent.futures import Future, as_completed
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from bench.console import ConsoleLog
from bench.results import content_key
from bench.study import study_of
from sweeps.build import build, target_of
from sweeps.configured import trained
from sweeps.device_lock import device_lock, on_gpu
from sweeps.failures import reason
from sweeps.plan import Planned
from sweeps.processes import processes
from sweeps.terminal import time_left

OF_MEASUREMENT = ("engine", "precision", "protocol", "pictures")
"""Settings of run.yaml that no training depends on."""


def train_ahead(jobs: Sequence[Planned], measured: Collection[str]) -> None:
    """Train the models of `jobs`, which share one budget, as many at a time as the cores allow.

    Trainings of jobs whose key is in `measured` are skipped. The jobs load the stored stages when
    they are measured. A training that fails here fails again then, and is reported then.
    """
    todo: dict[str, Planned] = {}
    for job in jobs:
        todo.setdefault(_training(job), job)
    for job in jobs:
        if job.key in measured:
            todo.pop(_training(job), None)
    if len(todo) < 2:
        return
    workers = room(jobs[0].config)
    log = ConsoleLog(Path(jobs[0].config.outputs))
    log.info(f"training {len(todo)} models, {workers} at a time")
    begun = time.monotonic()
    with device_lock("cpu", log), processes(workers) as pool:
        names = {pool.submit(_train, job.config): job.name for job in todo.values()}
        for number, ended in enumerate(as_completed(names), 1):
            left = time_left(time.monotonic() - begun, number, len(todo) - number)
            print(f"{_said(ended)}: {names[ended]}{left}", file=sys.stderr)


def room(config: DictConfig) -> int:
    """How many trainings can run at a time; 1 on a GPU, or if the budget sets no `threads`."""
    threads = build(config, "budget").threads
    if threads is None or on_gpu(config.device):
        return 1
    return len(os.sched_getaffinity(0)) // threads


def _training(job: Planned) -> str:
    """A key of all settings that a training may depend on; equal for jobs that share it."""
    method = job.settings["method"]
    chosen = study_of(target_of(method)).chosen
    return content_key(
        {**_without(job.settings, OF_MEASUREMENT), "method": _without(method, chosen)}
    )


def _without(settings: Mapping[str, Any], names: Collection[str]) -> dict[str, Any]:
    return {name: value for name, value in settings.items() if name not in names}


def _train(config: DictConfig) -> float:
    """Train, or load the training, in a worker process; return the seconds it took."""
    return trained(config, ConsoleLog(Path(config.outputs), quiet=True)).train_s


def _said(ended: Future[float]) -> str:
    error = ended.exception()
    return f"trained in {ended.result():.0f} s" if error is None else f"failed: {reason(error)}"

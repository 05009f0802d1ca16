"""Jobs that are measured together: found in the store, or measured and put there."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig

from bench.console import ConsoleLog
from bench.results import Store, content_key
from bench.run import Task, measure
from bench.types import Log, Method
from sweeps import failures
from sweeps.build import build
from sweeps.configured import checked_settings, scene_folder, scene_of
from sweeps.deliver import send
from sweeps.device_lock import device_lock
from sweeps.identity import described, run_parts


@dataclass(frozen=True)
class Job:
    """A run that is wanted.

    Attributes:
        config: the composed run.yaml.
        command: the words of the command line that makes it alone, for the record.
        name: its name at the terminal.
    """

    config: DictConfig
    command: Sequence[str]
    name: str = ""


@dataclass(frozen=True)
class Group:
    """Jobs that are measured in turns; mostly a single one.

    Several share scene, trajectory, protocol and seed.

    Attributes:
        turns: the name of the group; a single job has none.
        first: the number of the first job among those of all groups.
    """

    jobs: Sequence[Job]
    turns: str = ""
    first: int = 0

    @property
    def outputs(self) -> Path:
        """The folder of the store."""
        return Path(self.jobs[0].config.outputs)


@dataclass(frozen=True)
class Obtained:
    """A run in the store; `measured` says whether it had to be measured just now."""

    store: Store
    run: str
    measured: bool


def obtain(group: Group) -> list[Obtained]:
    """Measure the jobs of `group`, unless the store has all of them; forget earlier failures.

    If it has some, these are measured again: figures that are compared come from the same hour.

    Raises:
        SteerbenchError: a setting is wrong, or something in the measurement went wrong.
    """
    log = ConsoleLog(group.outputs)
    ready = _ready(group, log)
    if _stored(ready):
        return _told(ready, False, log)
    with device_lock(ready[0].method.settings()["device"], log):
        measured = not _stored(ready)  # by another process meanwhile
        if measured:
            _measure(ready, log)
    return _told(ready, measured, log)


def stored(group: Group) -> list[Obtained]:
    """The runs that `obtain` would find in the store, if it has all; otherwise none.

    Raises as `obtain` does.
    """
    log = ConsoleLog(group.outputs)
    ready = _ready(group, log)
    return _told(ready, False, log) if _stored(ready) else []


@dataclass(frozen=True, eq=False)
class _Ready:
    """A job ready to be measured; `parts` is everything that can change its rows."""

    job: Job
    method: Method
    task: Task
    parts: Mapping[str, Any]
    store: Store

    @classmethod
    def of(cls, job: Job, turns: str, log: Log) -> _Ready:
        config, settings = job.config, checked_settings(job.config)
        torch.manual_seed(settings.seed)
        method, budget, protocol = (
            build(config, name) for name in ("method", "budget", "protocol")
        )
        scene = scene_of(config)
        trajectory = build(config, "trajectory", scene)
        weights = Path(settings.weights_dir) if settings.weights_dir else None
        parts = run_parts(config, scene, method, trajectory)
        parts["lpips"] = protocol.find_lpips(weights, log)
        if turns:
            parts["turns"] = turns
        task = Task(scene, trajectory, protocol, budget, settings.seed, weights, settings.pictures)
        return cls(job, method, task, parts, Store(Path(settings.outputs)))

    @cached_property
    def run(self) -> str:
        """Its key in the store."""
        return self.store.key(self.parts)


def _ready(group: Group, log: Log) -> list[_Ready]:
    """The jobs of `group`, ready to be measured.

    With `turns`, each key includes the keys of the whole group: if one job changes, all are
    measured again.
    """
    ready = [_Ready.of(job, group.turns, log) for job in group.jobs]
    if not group.turns:
        return ready
    beside = sorted(content_key(each.parts) for each in ready)
    return [replace(each, parts={**each.parts, "beside": beside}) for each in ready]


def _stored(ready: Sequence[_Ready]) -> bool:
    return all(each.store.find(each.run) for each in ready)


def _told(ready: Sequence[_Ready], measured: bool, log: Log) -> list[Obtained]:
    """Forget earlier failures of runs that the store has now, and send them to their tracker."""
    for each in ready:
        config, store, run = each.job.config, each.store, each.run
        if not measured:
            log.info(f"already measured; to measure again, remove {store.folder / run}")
        failures.forget(Path(config.outputs), described(config))
        send(config, store, run, each.method.name)
    return [Obtained(each.store, each.run, measured) for each in ready]


def _measure(ready: Sequence[_Ready], log: Log) -> None:
    """Measure all, and put them in the place of what an interruption has left of them."""
    measurements = measure([each.method for each in ready], ready[0].task, log)
    for each in ready:
        each.store.remove(each.run)
    for each, measurement in zip(ready, measurements, strict=True):
        command, place = shlex.join(each.job.command), scene_folder(each.job.config)
        record = {**measurement.record, "command": command, "scene_path": place}
        each.store.save(each.parts, replace(measurement, record=record))

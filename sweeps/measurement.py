"""One measurement: builds it from a configuration, finds it in the store or makes it, shows it."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from rich.columns import Columns

from bench.console import ConsoleLog
from bench.results import Measurement, Store, content_key
from bench.run import Task, measure_in_turns
from bench.types import Log, Method
from reports.runs import Run, load
from reports.tables import run_tables
from sweeps import failures
from sweeps.build import build
from sweeps.configured import checked_settings, scene_folder, scene_of
from sweeps.deliver import send, write
from sweeps.device_lock import device_lock
from sweeps.identity import described, run_parts
from sweeps.terminal import console, rich_table

Asked = tuple[DictConfig, Sequence[str]]
"""The configuration of a measurement, and the command that asks for it."""


@dataclass(frozen=True)
class Obtained:
    """A run in the store; `measured` says whether it had to be measured just now."""

    store: Store
    run: str
    measured: bool


def execute(config: DictConfig, command: Sequence[str]) -> None:
    """Obtain the run that `config` describes, print its tables, write the page it asks for.

    Raises as `obtain` does, and if the page cannot be written.
    """
    obtained = obtain(config, command)
    label = HydraConfig.get().runtime.choices["method"]
    (run,) = load(obtained.store, {obtained.run: label})
    _show(run, explain=not obtained.measured)
    write(config, obtained.store, {obtained.run: label})


def obtain(config: DictConfig, command: Sequence[str]) -> Obtained:
    """Measure what `config` describes, unless the store has it; then forget its earlier failures.

    Args:
        config: the composed run.yaml.
        command: the words of the command line, for the record.

    Raises:
        SteerbenchError: a setting is wrong, or something in the measurement went wrong.
    """
    return obtain_in_turns([(config, command)])[0]


def obtain_in_turns(jobs: Sequence[Asked], turns: str = "") -> list[Obtained]:
    """`obtain` several jobs side by side; they share scene, trajectory, protocol and seed.

    Unless the store has all of them, each frame is rendered by all before the next one, see
    `bench.run.measure_in_turns`. `turns` is the name of the group; a single job has none.
    Raises as `obtain` does.
    """
    log = ConsoleLog(Path(jobs[0][0].outputs))
    ready = _ready(jobs, turns, log)
    for one in ready:
        if one.stored:
            one.say_stored(log)
    missing = [one for one in ready if not one.stored]
    if missing:
        with device_lock(missing[0].method.settings()["device"], log):
            missing = [one for one in missing if not one.stored]  # by another process meanwhile
            if missing:
                methods = [one.method for one in ready]
                found = measure_in_turns(methods, missing[0].task, log)
                for one, measurement in zip(ready, found, strict=True):
                    if one in missing:
                        one.keep(measurement)
    for config, _ in jobs:
        failures.forget(Path(config.outputs), described(config))
    for one in ready:
        send(one.config, one.store, one.run, one.method.name)
    measured = {one.run for one in missing}
    return [Obtained(one.store, one.run, one.run in measured) for one in ready]


def stored(jobs: Sequence[Asked], turns: str = "") -> list[Obtained]:
    """The runs that `obtain_in_turns` would find in the store, if it has all; otherwise none.

    Raises as `obtain` does.
    """
    log = ConsoleLog(Path(jobs[0][0].outputs))
    ready = _ready(jobs, turns, log)
    if not all(one.stored for one in ready):
        return []
    for one in ready:
        one.say_stored(log)
        failures.forget(Path(one.config.outputs), described(one.config))
    return [Obtained(one.store, one.run, measured=False) for one in ready]


@dataclass(frozen=True, eq=False)
class _Ready:
    """A measurement ready to start; `parts` is everything that can change its rows."""

    config: DictConfig
    command: Sequence[str]
    method: Method
    task: Task
    parts: Mapping[str, Any]
    store: Store

    @classmethod
    def of(cls, config: DictConfig, command: Sequence[str], turns: str, log: Log) -> _Ready:
        settings = checked_settings(config)
        torch.manual_seed(settings.seed)
        method, budget, protocol = (
            build(config, name) for name in ("method", "budget", "protocol")
        )
        scene = scene_of(config)
        trajectory = build(config, "trajectory", scene)
        weights = Path(settings.weights_dir) if settings.weights_dir else None
        parts = run_parts(config, scene, method, trajectory) | {
            "lpips": protocol.find_lpips(weights, log)
        }
        parts |= {"turns": turns} if turns else {}
        task = Task(scene, trajectory, protocol, budget, settings.seed, weights, settings.pictures)
        return cls(config, command, method, task, parts, Store(Path(settings.outputs)))

    @cached_property
    def run(self) -> str:
        """Its key in the store."""
        return self.store.key(self.parts)

    @property
    def stored(self) -> bool:
        return self.store.find(self.run) is not None

    def say_stored(self, log: Log) -> None:
        log.info(f"already measured; to measure again, remove {self.store.folder / self.run}")

    def keep(self, measurement: Measurement) -> None:
        """Store the measurement, with its command and the folder of its scene."""
        more = {"command": shlex.join(self.command), "scene_path": scene_folder(self.config)}
        record = {**measurement.record, **more}
        self.store.save(self.parts, replace(measurement, record=record))


def _ready(jobs: Sequence[Asked], turns: str, log: Log) -> list[_Ready]:
    """The measurements of `jobs`.

    With `turns`, each key includes the keys of the whole group: if one job changes, all are
    measured again, so that the lines of a table come from the same hour.
    """
    ready = [_Ready.of(config, command, turns, log) for config, command in jobs]
    if not turns:
        return ready
    beside = sorted(content_key(one.parts) for one in ready)
    return [replace(one, parts={**one.parts, "beside": beside}) for one in ready]


def _show(run: Run, explain: bool) -> None:
    """Print the tables of one run and, if `explain`, why figures are missing."""
    what = run.facts[["method", "scene", "trajectory", "resolution", "budget", "protocol"]]
    out = console()
    heading = f"{', '.join(what)}, seed {run.facts['seed']}: run {run.key}"
    out.print(heading, style="bold", markup=False)
    out.print(Columns([rich_table(table) for table in run_tables(run.rows)]))
    for metric, reason in run.record["missing"].items() if explain else ():
        out.print(f"{metric}: n/a. {reason}", markup=False, soft_wrap=True)

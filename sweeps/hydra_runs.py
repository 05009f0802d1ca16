"""Hydra composes the configuration of every job of a command and runs it."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable, Collection, Sequence
from contextvars import ContextVar
from dataclasses import dataclass, field
from math import prod
from pathlib import Path
from typing import TYPE_CHECKING, Any

import hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from bench.errors import unexpected
from sweeps.overrides import CONFIGS, as_typed, explain, further, hint, of_hydra, settled, swept

if TYPE_CHECKING:  # these load torch, which --help and completion do not need
    from sweeps.execute import Ended
    from sweeps.measurement import Job


@dataclass
class RunningSweep:
    """The sweep of a call of `main`: the `folder` where jobs record how they ended, None without a
    sweep, and the jobs that wait to be measured in turns, with their numbers."""

    folder: Path | None = None
    waiting: list[tuple[int, Job]] = field(default_factory=list)


_sweep: ContextVar[RunningSweep] = ContextVar("sweep")
"""The sweep of the present call of `main`. Hydra itself makes the object that learns of a sweep."""


class SweepCallback(Callback):
    """Notes that a sweep starts; run.yaml lists it among Hydra's callbacks."""

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Note the folder of the sweep, before its launcher is made."""
        from sweeps.execute import join_cluster, own_folder

        _sweep.get().folder = own_folder(config)
        join_cluster(config)


def run_hydra(
    argv: Sequence[str], alone: Callable[[DictConfig, list[str]], object]
) -> tuple[list[Ended], list[Exception]]:
    """Do what `argv` says: a sweep, one job, which is left to `alone` with its configuration and
    its command, or Hydra's own help.

    A failed job of a sweep is reported at once, and the others still run. Returns how the jobs of
    the sweep ended, and the errors. SteerbenchError if the sweep has several stores.
    """
    argv = as_typed(argv)
    if several := swept([word for word in argv if word.startswith("outputs=")]):
        got = ", ".join(several["outputs"]) + hint(f"outputs={','.join(several['outputs'])}")
        raise unexpected("outputs", "one folder, for the table of all jobs", got)
    # Hydra's parser accepts overrides only in one contiguous block, so flags go first.
    flags = [word for word in argv if word.startswith("-") or not re.search("^~|=", word)]
    sys.argv = [sys.argv[0], *flags, *(word for word in argv if word not in flags)]
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra raises its errors instead of printing them
    _hide_subcommand_from_completion()
    errors: list[Exception] = []

    def job(config: DictConfig) -> None:
        present = HydraConfig.get()
        sources = present.runtime.config_sources
        folders = [f"--config-dir={x.path}" for x in sources if x.provider == "command-line"]
        command = ["steerbench", "run", *folders, *present.overrides.task]
        several = present.mode == RunMode.MULTIRUN
        try:
            config = settled(config, further(folders))
            if several:
                _one_of_many(config, command)
            else:
                alone(config, command)
        except Exception as error:
            if several and present.runtime.choices["hydra/launcher"] != "basic":
                raise  # in another process, whose errors are not these
            errors.append(error)  # bypasses Hydra, which would print it in its own way

    token = _sweep.set(sweep := RunningSweep())
    try:
        hydra.main(str(CONFIGS), "run", version_base="1.3")(job)()
    except Exception as error:
        errors.append(explain(error, argv) if of_hydra(error) else error)
    finally:
        _sweep.reset(token)
    if sweep.folder is None:
        return [], errors
    from sweeps.execute import read

    errors += _in_turns(sweep.waiting, sweep.folder)
    return read(sweep.folder), errors


def _one_of_many(config: DictConfig, command: Sequence[str]) -> None:
    from sweeps.execute import attempt
    from sweeps.measurement import Job, turns_of
    from sweeps.processes import set_up

    set_up()  # the launcher may have started this process
    present = HydraConfig.get()
    sizes = _sizes(Path(present.runtime.output_dir) / "multirun.yaml")
    name = label(present.runtime.choices["method"], present.overrides.task, sizes or ())
    total = 0 if sizes is None else prod(sizes.values())
    number, folder = present.job.num, Path(present.runtime.output_dir)
    if config.in_turns:
        launcher = present.runtime.choices["hydra/launcher"]
        if launcher != "basic":
            expected = "false with a launcher, because one process renders all frames"
            raise unexpected("in_turns", expected, f"true with hydra/launcher={launcher}")
        turns = turns_of(present.runtime.choices.get("experiment", "sweep"), config)
        _sweep.get().waiting.append((number, Job(config, command, name, turns)))
    elif errors := attempt([(number, Job(config, command, name))], total, folder):
        raise errors[0]


def _in_turns(waiting: Sequence[tuple[int, Job]], folder: Path) -> list[Exception]:
    """Measure the jobs of a sweep: those that differ only in their method together, in turns."""
    from bench.results import content_key
    from sweeps.execute import attempt

    groups: dict[str, list[tuple[int, Job]]] = {}
    for number, job in waiting:
        of_method = ("method", "engine", "precision")
        shared = {name: of for name, of in job.settings.items() if name not in of_method}
        groups.setdefault(content_key(shared), []).append((number, job))
    return [error for group in groups.values() for error in attempt(group, len(waiting), folder)]


def _sizes(file: Path) -> dict[str, int] | None:
    """How many values each swept setting has, by the file of Hydra's own sweeper; else None."""
    if not file.exists():
        return None
    sweep = OmegaConf.load(file).hydra
    params = sweep.sweeper.get("params") or {}
    words = [*(f"{name}={values}" for name, values in params.items()), *sweep.overrides.task]
    values = swept(words, GlobalHydra.instance().config_loader())
    return {name: len(several) for name, several in values.items()}


def label(method: str, overrides: Sequence[str], names: Collection[str]) -> str:
    """The label of a job among others: its method, and its values of the settings `names`.

    A name is shortened to its last part unless that is ambiguous.
    """
    settings = dict(word.split("=", 1) for word in overrides if "=" in word)
    names = [name for name in names if name in settings and name != "method"]
    ends = [name.rpartition(".")[2] for name in names]
    shown = [
        f"{end if ends.count(end) == 1 else name}={settings[name]}"
        for name, end in zip(names, ends, strict=True)
    ]
    return f"{method} ({', '.join(shown)})" if shown else method


def _hide_subcommand_from_completion() -> None:
    """Hydra's completion knows no subcommands: show it `steerbench run a=b` as `steerbench a=b`."""
    program, _, rest = os.environ.get("COMP_LINE", "").lstrip().partition(" ")
    if rest.lstrip().startswith("run "):
        os.environ["COMP_LINE"] = f"{program} {rest.lstrip().removeprefix('run ')}"

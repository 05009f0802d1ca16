"""Hydra composes the configuration of every job of a command."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from contextvars import ContextVar
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig, flag_override

from bench.errors import unexpected
from bench.kinds import Words
from sweeps.overrides import CONFIGS, as_typed, explain, further, hint, of_hydra, settled, taken

if TYPE_CHECKING:  # these load torch, which --help and completion do not need
    from sweeps.execute import Ended
    from sweeps.measurement import Job


_sweeps: ContextVar[list[DictConfig]] = ContextVar("sweeps")
"""Hydra's configurations of the sweeps of the present call: Hydra itself makes the object that
learns of one."""


class SweepCallback(Callback):
    """Lets Hydra compose the jobs of a sweep, and no more; run.yaml lists it as a callback."""

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Note Hydra's configuration, and have its jobs called here, one after the other."""
        from sweeps.execute import own_folder

        own_folder(config)
        _sweeps.get().append(config.copy())
        with flag_override(config, ["readonly", "struct"], False):
            basic = "hydra._internal.core_plugins.basic_launcher.BasicLauncher"
            config.hydra.launcher = {"_target_": basic}


def run_hydra(
    argv: Words, alone: Callable[[DictConfig, list[str]], object]
) -> tuple[list[tuple[Job, Ended]], list[Exception]]:
    """Do what `argv` says: a sweep, one job, which is left to `alone` with its configuration and
    its command, or Hydra's own help.

    A failed job of a sweep is reported at once, and the others still run. Returns the jobs of the
    sweep, how each ended, and all errors. SteerbenchError if the sweep has several stores.
    """
    argv = as_typed(argv)
    _, folders = taken(argv, "outputs")
    if len(folders) > 1:
        got = ", ".join(folders) + hint(f"outputs={','.join(folders)}")
        raise unexpected("outputs", "one folder, for the table of all jobs", got)
    # Hydra's parser accepts overrides only in one contiguous block, so flags go first.
    flags = [word for word in argv if word.startswith("-") or not re.search("^~|=", word)]
    sys.argv = [sys.argv[0], *flags, *(word for word in argv if word not in flags)]
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra raises its errors instead of printing them
    _hide_subcommand_from_completion()
    errors: list[Exception] = []
    found: list[tuple[Job, str]] = []  # each with its choice of a method

    def job(config: DictConfig) -> None:
        present = HydraConfig.get()
        sources = present.runtime.config_sources
        folders = [f"--config-dir={x.path}" for x in sources if x.provider == "command-line"]
        command = ["steerbench", "run", *folders, *present.overrides.task]
        try:
            config = settled(config, further(folders))
            if present.mode == RunMode.MULTIRUN:
                found.append((_job(config, command), present.runtime.choices["method"]))
            else:
                alone(config, command)
        except Exception as error:
            errors.append(error)  # bypasses Hydra, which would print it in its own way

    sweeps: list[DictConfig] = []
    token = _sweeps.set(sweeps)
    try:
        hydra.main(str(CONFIGS), "run", version_base="1.3")(job)()
    except Exception as error:
        errors.append(explain(error, argv) if of_hydra(error) else error)
    finally:
        _sweeps.reset(token)
    if not found:
        return [], errors
    from sweeps.execute import Launcher, run_jobs

    jobs = _named(found)
    ended = run_jobs(jobs, Launcher(sweeps[0], argv))
    errors += [each.error for each in ended if each.error]
    return list(zip(jobs, ended, strict=True)), errors


def _job(config: DictConfig, command: Words) -> Job:
    from sweeps.measurement import Job, turns_of

    experiment = HydraConfig.get().runtime.choices.get("experiment", "sweep")
    job = Job(config, command, turns=turns_of(experiment, config) if config.in_turns else "")
    assert job.key  # what has none is refused now
    return job


def _named(found: Sequence[tuple[Job, str]]) -> list[Job]:
    """The jobs with labels, made of what differs between them."""
    settings = [dict(x.split("=", 1) for x in job.command if "=" in x) for job, _ in found]
    names = [x for x in settings[0] if len({of.get(x) for of in settings}) > 1]
    return [
        replace(job, name=label(method, {name: of[name] for name in names if name in of}))
        for (job, method), of in zip(found, settings, strict=True)
    ]


def label(method: str, varied: Mapping[str, str]) -> str:
    """The label of a job among others: its method, and what it has of the settings that vary."""
    from reports.lines import shortened

    short = shortened([name for name in varied if name != "method"])
    shown = [f"{end}={varied[name]}" for name, end in short.items()]
    return f"{method} ({', '.join(shown)})" if shown else method


def _hide_subcommand_from_completion() -> None:
    """Hydra's completion knows no subcommands: show it `steerbench run a=b` as `steerbench a=b`."""
    program, _, rest = os.environ.get("COMP_LINE", "").lstrip().partition(" ")
    if rest.lstrip().startswith("run "):
        os.environ["COMP_LINE"] = f"{program} {rest.lstrip().removeprefix('run ')}"

"""`steerbench run`: Hydra composes the configuration of every job and runs it."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from sweeps.overrides import CONFIGS, explain, of_hydra, settled
from sweeps.sweep_callback import SweepCallback


def main(argv: Sequence[str]) -> int:
    """Run one job, a sweep, or Hydra's own help, as the overrides and flags in `argv` say.

    In a sweep, a failed job is reported at once and the others still run; the table at the end
    lists all of them.

    Raises:
        SteerbenchError: a setting or a choice does not exist, or a job failed.
    """
    # Hydra's parser accepts overrides only in one contiguous block, so flags go first.
    sys.argv = [sys.argv[0], *sorted(argv, key=_is_override)]
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra raises its errors instead of printing them
    _hide_subcommand_from_completion()
    SweepCallback.folder = None
    error = _launch(argv)
    if SweepCallback.folder is not None:
        from sweeps.sweep import finish

        finish(SweepCallback.folder)
    if error is not None:
        raise error
    return 0


def _launch(argv: Sequence[str]) -> Exception | None:
    """Let Hydra run every job; return the error of a job or of a wrong setting, if any."""
    failures: list[Exception] = []

    def job(config: DictConfig) -> None:
        # These load torch, which --help and completion do not need.
        from sweeps.measurement import execute
        from sweeps.sweep import run_job

        command = ["steerbench", "run", *_config_dir(), *HydraConfig.get().overrides.task]
        if HydraConfig.get().mode == RunMode.MULTIRUN:
            run_job(settled(config), command)
            return
        try:
            execute(settled(config), command)
        except Exception as error:
            failures.append(error)  # bypasses Hydra, which would print it in its own way

    try:
        hydra.main(str(CONFIGS), "run", version_base="1.3")(job)()
    except Exception as error:
        if not of_hydra(error):
            return error
        explained = explain(error, argv)
        explained.__cause__ = error
        return explained
    return failures[0] if failures else None


def _config_dir() -> list[str]:
    """The folder of further choices from the command line, as one word, for the job's command."""
    sources = HydraConfig.get().runtime.config_sources
    return [f"--config-dir={x.path}" for x in sources if x.provider == "command-line"]


def _is_override(argument: str) -> bool:
    return argument.startswith("~") or ("=" in argument and not argument.startswith("-"))


def _hide_subcommand_from_completion() -> None:
    """Hydra's completion knows no subcommands: show it `steerbench run a=b` as `steerbench a=b`."""
    program, _, rest = os.environ.get("COMP_LINE", "").lstrip().partition(" ")
    if rest.lstrip().startswith("run "):
        os.environ["COMP_LINE"] = f"{program} {rest.lstrip().removeprefix('run ')}"

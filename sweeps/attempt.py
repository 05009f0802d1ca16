"""One job among others: what is said when it ends, what it leaves behind when it fails."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from datetime import timedelta
from pathlib import Path

from omegaconf import DictConfig

from reports.runs import load
from reports.tables import decimal
from sweeps import failures
from sweeps.measurement import Obtained, described, obtain


def attempt(config: DictConfig, command: Sequence[str], name: str) -> Obtained:
    """Obtain the run that `config` describes; a failure is told at once and kept for reports.

    Raises as `obtain` does.
    """
    try:
        return obtain(config, command)
    except Exception as error:
        print(f"steerbench: failed: {name}: {error}", file=sys.stderr)
        with failures.told_only():
            failures.keep(Path(config.outputs), described(config), failures.reason(error))
        raise


def say(obtained: Obtained, name: str, more: str) -> None:
    """Print the figures of a job in a line."""
    (run,) = load(obtained.store, {obtained.run: name})
    psnr, ms = decimal(run.values.get("psnr"), 2), decimal(run.values["frame_ms"], 1)
    print(f"{name}: {psnr} dB, {ms} ms a frame{more}", file=sys.stderr)


def time_left(seconds: float, measured: int, jobs: int) -> str:
    """How long `jobs` may take after `measured` ones took `seconds`; nothing where none tells."""
    if not (measured and jobs):
        return ""
    return f", about {timedelta(seconds=round(seconds / measured * jobs))} left"

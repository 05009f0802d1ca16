"""One job among others: its line at the terminal, and its record in the folder of a sweep."""

from __future__ import annotations

import json
import sys
from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass
from datetime import timedelta
from pathlib import Path

from omegaconf import DictConfig

from bench.errors import explained
from bench.sharing import whole
from reports.runs import load
from reports.tables import decimal
from sweeps import failures
from sweeps.identity import described
from sweeps.measurement import Obtained, obtain_in_turns

SUFFIX = ".job.json"


@dataclass(frozen=True)
class Job:
    """How one job of a sweep ended.

    Attributes:
        number: from 0, in the order of the sweep.
        method: the chosen name of its method.
        overrides: as Hydra passes them to the job, `key=value` each.
        outputs: the folder with its store.
        report: the folder of its page, or None.
        begun: when it started, in seconds since the epoch.
        measured: whether it had to be measured; False if the store had it.
        run: its key in the store, or None if it failed.
        failure: why it failed, in one line.
    """

    number: int
    method: str
    overrides: tuple[str, ...]
    outputs: str
    report: str | None
    begun: float
    measured: bool = False
    run: str | None = None
    failure: str | None = None

    def write(self, folder: Path) -> None:
        """Write the job to `folder`, atomically."""
        with explained(folder), whole(folder / f"{self.number}{SUFFIX}") as new:
            new.write_text(json.dumps(asdict(self), indent=1) + "\n", encoding="utf-8")

    def label(self, names: Collection[str]) -> str:
        """The label of the job among others: its method, and its values of the settings `names`.

        A name is shortened to its last part unless that is ambiguous.
        """
        ends = [name.rpartition(".")[2] for name in names]
        shown = [
            f"{end if ends.count(end) == 1 else name}={self.settings[name]}"
            for name, end in zip(names, ends, strict=True)
            if name in self.settings
        ]
        return f"{self.method} ({', '.join(shown)})" if shown else self.method

    @property
    def settings(self) -> dict[str, str]:
        """The overrides by name, except the method."""
        pairs = (override.split("=", 1) for override in self.overrides if "=" in override)
        return {name: value for name, value in pairs if name != "method"}


def read(folder: Path) -> list[Job]:
    """Read every job that has ended, in the order of the sweep."""
    texts = (path.read_text(encoding="utf-8") for path in folder.glob(f"*{SUFFIX}"))
    jobs = [
        Job(**fields | {"overrides": tuple(fields["overrides"])})
        for fields in map(json.loads, texts)
    ]
    return sorted(jobs, key=lambda job: job.number)


def varying(jobs: Sequence[Job]) -> list[str]:
    """Names of the settings that differ between jobs."""
    names = dict.fromkeys(name for job in jobs for name in job.settings)
    return [name for name in names if len({job.settings.get(name) for job in jobs}) > 1]


def attempt(config: DictConfig, command: Sequence[str], name: str) -> Obtained:
    """Obtain the run that `config` describes; print a failure at once and keep it for reports.

    Raises as `obtain` does.
    """
    return attempt_in_turns([(config, command, name)])[0]


def attempt_in_turns(
    jobs: Sequence[tuple[DictConfig, Sequence[str], str]], turns: str = ""
) -> list[Obtained]:
    """`attempt` several jobs in turns, see `obtain_in_turns`; if one fails, all fail."""
    try:
        return obtain_in_turns([(config, command) for config, command, _ in jobs], turns)
    except Exception as error:
        for config, _, name in jobs:
            print(f"steerbench: failed: {name}: {error}", file=sys.stderr)
            with failures.printed():
                failures.keep(Path(config.outputs), described(config), failures.reason(error))
        raise


def say(obtained: Obtained, name: str, more: str) -> None:
    """Print the figures of a job in one line, and `more` after them."""
    (run,) = load(obtained.store, {obtained.run: name})
    psnr, ms = decimal(run.values.get("psnr"), 2), decimal(run.values["frame_ms"], 1)
    print(f"{name}: {psnr} dB, {ms} ms a frame{more}", file=sys.stderr)


def time_left(seconds: float, measured: int, jobs: int) -> str:
    """Estimated time for `jobs` if `measured` ones took `seconds`; empty if none was measured."""
    if not (measured and jobs):
        return ""
    return f", about {timedelta(seconds=round(seconds / measured * jobs))} left"

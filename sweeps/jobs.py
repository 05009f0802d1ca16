"""What every job of a sweep leaves in the folder of the sweep, in whichever process it ran."""

from __future__ import annotations

import json
from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from bench.errors import explained
from bench.sharing import whole

SUFFIX = ".job.json"


@dataclass(frozen=True)
class Job:
    """How one job of a sweep ended.

    Attributes:
        number: from 0, in the order of the sweep.
        method: the name that was chosen for it.
        overrides: as Hydra hands them to the job, `key=value` each.
        outputs: the folder with its store.
        report: the folder of its page, or None.
        begun: seconds since the epoch.
        measured: whether it had to be measured; False when the store had it.
        run: its key in the store, or None when it failed.
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
        """Leave it in `folder`; it appears there whole or not at all."""
        with explained(folder), whole(folder / f"{self.number}{SUFFIX}") as new:
            new.write_text(json.dumps(asdict(self), indent=1) + "\n", encoding="utf-8")

    def label(self, names: Collection[str]) -> str:
        """What the job is called beside others: its method, and its settings of these `names`.

        Of a name its last part is enough, unless another of them ends in the same.
        """
        ends = [name.rpartition(".")[2] for name in names]
        told = [
            f"{end if ends.count(end) == 1 else name}={self.settings[name]}"
            for name, end in zip(names, ends, strict=True)
            if name in self.settings
        ]
        return f"{self.method} ({', '.join(told)})" if told else self.method

    @property
    def settings(self) -> dict[str, str]:
        """The overrides by name, but for the method."""
        pairs = (override.split("=", 1) for override in self.overrides if "=" in override)
        return {name: value for name, value in pairs if name != "method"}


def read(folder: Path) -> list[Job]:
    """Every job that has ended, in the order of the sweep."""
    jobs = []
    for path in folder.glob(f"*{SUFFIX}"):
        fields = json.loads(path.read_text(encoding="utf-8"))
        jobs.append(Job(**fields | {"overrides": tuple(fields["overrides"])}))
    return sorted(jobs, key=lambda job: job.number)


def varying(jobs: Sequence[Job]) -> list[str]:
    """Names of the settings that are not the same in all jobs."""
    names = dict.fromkeys(name for job in jobs for name in job.settings)
    return [name for name in names if len({job.settings.get(name) for job in jobs}) > 1]

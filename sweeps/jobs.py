"""How jobs end: a line at the terminal, and a record in the folder that the jobs of a sweep share.

The jobs may run in other processes, so they share only this folder and the store.
"""

from __future__ import annotations

import json
import sys
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from hydra.core.hydra_config import HydraConfig

from bench.errors import explained
from bench.sharing import whole
from reports.runs import load
from reports.tables import decimal
from sweeps import failures
from sweeps.identity import described
from sweeps.measurement import Group, Job, Obtained, obtain
from sweeps.terminal import time_left

SUFFIX = ".job.json"


@dataclass(frozen=True)
class Ended:
    """How a job ended.

    Attributes:
        number: from 0, in the order of the sweep.
        outputs: the folder with its store.
        report: the folder of its page, or None.
        begun: when it started, in seconds since the epoch.
        measured: whether it had to be measured; False if the store had it.
        run: its key in the store, or None if it failed.
        failure: why it failed, in one line.
    """

    number: int
    name: str
    outputs: str
    report: str | None
    begun: float
    measured: bool = False
    run: str | None = None
    failure: str | None = None

    def write(self, folder: Path) -> None:
        """Write the record to `folder`, atomically."""
        with explained(folder), whole(folder / f"{self.number}{SUFFIX}") as new:
            new.write_text(json.dumps(asdict(self), indent=1) + "\n", encoding="utf-8")


def read(folder: Path) -> list[Ended]:
    """Read the records of all jobs that have ended, in the order of the sweep."""
    texts = (path.read_text(encoding="utf-8") for path in folder.glob(f"*{SUFFIX}"))
    return sorted((Ended(**json.loads(text)) for text in texts), key=lambda job: job.number)


def attempt(group: Group, total: int) -> None:
    """Obtain the runs of `group`, in a job of Hydra's; print and record how each job ended.

    Args:
        total: the number of jobs in the sweep; 0: not known.

    Raises as `obtain` does. The failure is printed, and kept for reports.
    """
    folder = Path(HydraConfig.get().runtime.output_dir)
    begun = time.time()
    jobs = [
        Ended(number, job.name, str(job.config.outputs), job.config.report, begun)
        for number, job in enumerate(group.jobs, group.first)
    ]
    try:
        results = obtain(group)
    except Exception as error:
        why = failures.reason(error)
        for job, ended in zip(group.jobs, jobs, strict=True):
            print(f"steerbench: failed: {job.name}: {error}", file=sys.stderr)
            with failures.printed():
                failures.keep(group.outputs, described(job.config), why)
            with failures.printed():
                replace(ended, failure=why).write(folder)
        raise
    for ended, result in zip(jobs, results, strict=True):
        replace(ended, run=result.run, measured=result.measured).write(folder)
    for job, result in zip(group.jobs, results, strict=True):
        say(job, result, _progress(folder, total))


def say(job: Job, obtained: Obtained, more: str = "") -> None:
    """Print the figures of a job in one line, and `more` after them."""
    (run,) = load(obtained.store, {obtained.run: job.name})
    psnr, ms = decimal(run.values.get("psnr"), 2), decimal(run.values["frame_ms"], 1)
    print(f"{job.name}: {psnr} dB, {ms} ms a frame{more}", file=sys.stderr)


def _progress(folder: Path, total: int) -> str:
    """How many jobs are done, and an estimate of the remaining time from the measured ones."""
    ended = read(folder)
    if len(ended) > total:
        return ""
    seconds = time.time() - min(job.begun for job in ended)
    measured = sum(job.measured for job in ended)
    left = time_left(seconds, measured, total - len(ended))
    return f"; {len(ended)} of {total} jobs done{left}"

"""`steerbench paper`: every table of the SteerNeRF paper, measured, as one page."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import timedelta
from itertools import product
from pathlib import Path

from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig

from bench.results import Store, explained
from reports.published import PaperTable, paper_tables, section
from reports.runs import load
from reports.tables import number
from sweeps.measurement import Obtained, obtain
from sweeps.names import unknown
from sweeps.overrides import composed


@dataclass(frozen=True)
class Planned:
    """A job of the sweep of a table: the settings it adds, and its whole configuration."""

    table: str
    settings: Mapping[str, str]
    config: DictConfig
    command: Sequence[str]


def main(options: argparse.Namespace) -> int:
    """Measure what the store does not have yet, then write the page; 1 if a job failed."""
    tables = {table.name: table for table in paper_tables()}
    if options.table is not None:
        if options.table not in tables:
            raise unknown("table", options.table, tables)
        tables = {options.table: tables[options.table]}
    jobs = [job for name in tables for job in plan(name, options.overrides)]
    ended = _run(jobs)
    folder = options.report or Path(jobs[0].config.outputs) / "paper"
    page = _write(list(tables.values()), jobs, ended, Path(jobs[0].config.outputs), folder)
    print(f"report: {page}", file=sys.stderr)
    return int(any(isinstance(end, str) for end in ended))


def plan(table: str, overrides: Sequence[str]) -> list[Planned]:
    """The jobs of the experiment `table` under `overrides`, in the order of its sweep.

    Raises:
        SteerbenchError: an override cannot be read, or names nothing.
    """
    together = [f"+experiment={table}", *overrides]
    jobs = []
    experiment = composed(together, return_hydra_config=True)
    for settings in _grid(experiment.hydra.sweeper.params):
        own = [f"{name}={value}" for name, value in settings.items()]
        command = ["steerbench", "run", *together, *own, "hydra.mode=RUN"]
        jobs.append(Planned(table, settings, composed([*together, *own]), command))
    return jobs


def _grid(params: Mapping[str, object]) -> list[dict[str, str]]:
    """Every combination of the values that a sweep gives to its settings."""
    lines = [f"{name}={values}" for name, values in params.items()]
    swept = [
        [(parsed.get_key_element(), value) for value in parsed.sweep_string_iterator()]
        for parsed in OverridesParser.create().parse_overrides(lines)
    ]
    return [dict(combination) for combination in product(*swept)]


def _run(jobs: Sequence[Planned]) -> list[Obtained | str]:
    """Run one job after the other: what each obtained, or why it failed."""
    ended: list[Obtained | str] = []
    begun, measured = time.monotonic(), 0
    for number_, job in enumerate(jobs, 1):
        told = f"{job.table}: {', '.join(f'{k}={v}' for k, v in job.settings.items())}"
        print(f"{number_} of {len(jobs)}, {told}", file=sys.stderr)
        try:
            obtained = obtain(job.config, job.command)
        except Exception as error:  # whatever it is, the other jobs still run
            print(f"steerbench: failed: {told}: {error}", file=sys.stderr)
            ended.append(" ".join(str(error).split()) or type(error).__name__)
            continue
        ended.append(obtained)
        measured += obtained.measured
        print(
            f"{told}: {_told(obtained)}{_left(begun, measured, len(jobs) - number_)}",
            file=sys.stderr,
        )
    return ended


def _told(obtained: Obtained) -> str:
    (run,) = load(obtained.store, {obtained.run: ""})
    return f"{number(run.values.get('psnr'), 2)} dB, {number(run.values['frame_ms'], 1)} ms a frame"


def _left(begun: float, measured: int, jobs: int) -> str:
    if not (measured and jobs):
        return ""
    seconds = (time.monotonic() - begun) / measured * jobs
    return f"; at most {timedelta(seconds=round(seconds))} left"


def _write(
    tables: Sequence[PaperTable],
    jobs: Sequence[Planned],
    ended: Sequence[Obtained | str],
    outputs: Path,
    folder: Path,
) -> Path:
    """Write `folder/report.md`; it replaces an earlier one only when it is whole."""
    parts = ["# The tables of SteerNeRF, measured"]
    for table in tables:
        labels = {tuple(sorted(line.job.items())): line.label for line in table.lines if line.job}
        runs, failures = {}, {}
        for job, end in zip(jobs, ended, strict=True):
            if job.table != table.name:
                continue
            label = labels[tuple(sorted(job.settings.items()))]
            if isinstance(end, str):
                failures[label] = end
            else:
                (runs[label],) = load(Store(outputs), {end.run: label})
        parts.append(section(table, runs, failures))
    with explained(folder):
        folder.mkdir(parents=True, exist_ok=True)
        partial = folder / ".report.md.partial"
        partial.write_text("\n\n".join(parts) + "\n", encoding="utf-8")
        return partial.replace(folder / "report.md")

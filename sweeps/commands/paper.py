"""`steerbench paper` measures every table of the SteerNeRF paper and writes a page about them;
`steerbench report` writes the same page from the store alone."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from itertools import chain
from pathlib import Path

from bench.errors import SteerbenchError, Unavailable
from bench.results import Store
from reports import export
from reports.outliers import outlier_table, outliers
from reports.paper_page import write_paper_page
from sweeps.data_sets import DataSet, find
from sweeps.execute import Launcher, divided
from sweeps.gather import gather, newest
from sweeps.jobs import attempt, say
from sweeps.measurement import Group, Job, Obtained, stored
from sweeps.overrides import composed
from sweeps.plan import Planned, chosen, plan
from sweeps.terminal import console, show
from sweeps.train_ahead import room, train_ahead

DATA = "data="
"""Prefix of the word that names the folder of a data set."""


def main(options: argparse.Namespace) -> int:
    """Measure what the store lacks (unless only a report is wanted) and write the page.

    Returns 1 if a job failed that can run here. With `check`, instead names the runs that look
    broken, and returns 1 if there are any.
    """
    settings, of_hydra = divided(options.overrides)
    words, data = data_set(settings)
    if options.command == "report" and options.check:
        return _check(Store(Path(composed(words).outputs)))
    missing = data.missing if data else {}
    for name, why in missing.items():
        print(f"missing: {name}: {why}", file=sys.stderr)
    tables = chosen(options.table, options.methods)
    jobs = [job for table in tables for job in plan(table, words, data)]
    outputs = Path(jobs[0].config.outputs)
    failed = 0
    if options.command == "paper":
        failed = _run(jobs, Launcher([*options.config_dir, *of_hydra], outputs))
    runs = newest(Store(outputs))
    broken = outliers(list(chain(*runs.values())))
    folder = options.report or outputs / "paper"
    lines = gather(jobs, runs, outputs)
    page = write_paper_page(tables, lines, broken, folder, missing)
    if options.format:
        print(getattr(export, options.format)(tables, lines), end="")
    print(f"report: {page}", file=sys.stderr)
    return int(failed > 0)


def data_set(words: Sequence[str]) -> tuple[list[str], DataSet | None]:
    """The settings among `words`, and the data set if one of them names it (data=DIR).

    Raises:
        SteerbenchError: another word names a scene; or the data set has no scenes.
    """
    settings = [word for word in words if not word.startswith(DATA)]
    named = [word.removeprefix(DATA) for word in words if word.startswith(DATA)]
    scenes = [
        word for word in settings if word.lstrip("+~").partition("=")[0] in ("scene", "scene.path")
    ]
    if named and scenes:
        raise SteerbenchError(
            f"{DATA}{named[-1]} and {scenes[0]}: expected one of them; data names all scenes"
        )
    return settings, find(named[-1]) if named else None


def _run(jobs: Sequence[Planned], launcher: Launcher) -> int:
    """Run the jobs, equal ones only once; return how many of those that can run here failed.

    Goes scene by scene: measures all lines of all tables with the first seed, then with the next.
    Where there is room in this process, the models that the store lacks are trained before, in
    parallel; otherwise each job trains what it needs.
    """
    distinct = {job.key: job for job in reversed(jobs)}
    jobs = [job for job in jobs if distinct[job.key] is job]
    scenes, seeds = [job.scene for job in jobs], [job.config.seed for job in jobs]
    jobs.sort(key=lambda job: (scenes.index(job.scene), seeds.index(job.config.seed)))
    ahead = launcher.in_process and room(jobs[0].config) > 1
    groups, measured = _groups(jobs, look_up=ahead)
    if ahead:
        train_ahead(jobs, measured)
    total = sum(len(group.jobs) for group in groups)
    return sum(launcher.run(partial(_attempted, total=total), groups))


def _groups(jobs: Sequence[Planned], look_up: bool) -> tuple[list[Group], set[str]]:
    """The groups of the jobs; those with the same `turns` are one.

    With `look_up`, without the groups that the store has; and the keys of their jobs.
    """
    by_turns: dict[str, list[Planned]] = {}
    for job in jobs:
        by_turns.setdefault(job.turns or job.key, []).append(job)
    groups: list[Group] = []
    measured: set[str] = set()
    for planned in by_turns.values():
        wanted = [Job(job.config, job.command, job.name) for job in planned]
        first = sum(len(group.jobs) for group in groups)
        group = Group(wanted, planned[0].turns, first)
        there: list[Obtained] = []
        with suppress(SteerbenchError):  # a job that cannot start says so when it is measured
            there = stored(group) if look_up else []
        if there:
            measured |= {job.key for job in planned}
            for each, obtained in zip(wanted, there, strict=True):
                say(each, obtained)
        else:
            groups.append(group)
    return groups, measured


def _attempted(group: Group, total: int) -> int:
    """Attempt a group; return how many of its jobs failed that can run here."""
    for number, job in enumerate(group.jobs, group.first + 1):
        print(f"{number} of {total}, {job.name}", file=sys.stderr)
    try:
        attempt(group, total)
    except Unavailable:
        return 0
    except Exception:  # already printed; the other jobs still run
        return len(group.jobs)
    return 0


def _check(store: Store) -> int:
    runs = list(chain(*newest(store).values()))
    broken = outliers(runs)
    if broken:
        show(outlier_table(broken, runs))
    keys = {outlier.key for outlier in broken}
    console().print(f"{len(keys)} of {len(runs)} runs look broken")
    return int(len(keys) > 0)

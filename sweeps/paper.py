"""`steerbench paper` measures every table of the SteerNeRF paper and writes a page about them;
`steerbench report` writes the same page from the store alone."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Mapping, Sequence
from itertools import chain
from pathlib import Path

from bench.errors import SteerbenchError, Unavailable
from bench.results import Store
from reports import export
from reports.outliers import outlier_table, outliers
from reports.paper_page import write_paper_page
from sweeps.data_sets import DataSet, find
from sweeps.gather import gather, newest
from sweeps.jobs import attempt_in_turns, say, time_left
from sweeps.measurement import Obtained, stored
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
    words, data = data_set(options.overrides)
    if options.command == "report" and options.check:
        return _check(Store(Path(composed(words).outputs)))
    missing = data.missing if data else {}
    for name, why in missing.items():
        print(f"missing: {name}: {why}", file=sys.stderr)
    tables = chosen(options.table, options.methods)
    jobs = [job for table in tables for job in plan(table, words, data)]
    failed = _run(jobs) if options.command == "paper" else 0
    outputs = Path(jobs[0].config.outputs)
    runs = newest(Store(outputs))
    found = outliers(list(chain(*runs.values())))
    folder = options.report or outputs / "paper"
    lines = gather(jobs, runs, outputs)
    page = write_paper_page(tables, lines, found, folder, missing)
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


def _run(jobs: Sequence[Planned]) -> int:
    """Run the jobs, equal ones only once; return how many of those that can run here failed.

    Goes scene by scene: first trains all models, in parallel where possible; then measures all
    lines of all tables with the first seed, then with the next.
    """
    distinct = {job.key: job for job in reversed(jobs)}
    jobs = [job for job in jobs if distinct[job.key] is job]
    of_scenes: dict[str, list[Planned]] = {}
    for job in jobs:
        of_scenes.setdefault(job.scene, []).append(job)
    seconds, measured, failed, ended = 0.0, 0, 0, 0
    for together in of_scenes.values():
        there: dict[str, Obtained] = {}
        if room(together[0].config) > 1:  # otherwise each job is looked up in its turn
            there = {
                job.key: found
                for group in _groups(together)
                for job, found in zip(group, _stored(group), strict=False)
            }
            train_ahead(together, there)
        seeds = list(dict.fromkeys(job.config.seed for job in together))
        for group in _groups(sorted(together, key=lambda job: seeds.index(job.config.seed))):
            for number, job in enumerate(group, ended + 1):
                print(f"{number} of {len(jobs)}, {job.name}", file=sys.stderr)
            ended += len(group)
            begun = time.monotonic()
            try:
                obtained = _obtained(group, there)
            except Exception as error:  # already printed; the other jobs still run
                failed += 0 if isinstance(error, Unavailable) else len(group)
                continue
            measured += sum(of_job.measured for of_job in obtained)
            seconds += time.monotonic() - begun
            left = time_left(seconds, measured, len(jobs) - ended)
            for job, of_job in zip(group, obtained, strict=True):
                say(of_job, job.name, left)
    return failed


def _obtained(group: Sequence[Planned], there: Mapping[str, Obtained]) -> list[Obtained]:
    """The runs of a group: from `there`, by key, if it has all of them; otherwise measured now."""
    if all(job.key in there for job in group):
        return [there[job.key] for job in group]
    wanted = [(job.config, job.command, job.name) for job in group]
    return attempt_in_turns(wanted, group[0].turns)


def _stored(group: Sequence[Planned]) -> list[Obtained]:
    """The runs of a group if the store has all of them; otherwise none.

    Also none if a job cannot even start; the error is reported when it is measured.
    """
    try:
        return stored([(job.config, job.command) for job in group], group[0].turns)
    except SteerbenchError:
        return []


def _groups(jobs: Sequence[Planned]) -> list[list[Planned]]:
    """Group the jobs that are measured in turns; each other job is a group of its own."""
    groups: dict[object, list[Planned]] = {}
    for job in jobs:
        groups.setdefault(job.turns or job.key, []).append(job)
    return list(groups.values())


def _check(store: Store) -> int:
    runs = list(chain(*newest(store).values()))
    found = outliers(runs)
    if found:
        show(outlier_table(found, runs))
    broken = len({outlier.key for outlier in found})
    console().print(f"{broken} of {len(runs)} runs look broken")
    return int(len(found) > 0)

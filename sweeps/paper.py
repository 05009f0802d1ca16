"""`steerbench paper` measures every table of the SteerNeRF paper as one page; `steerbench report`
writes the same page from the store alone."""

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
"""How the word begins that names the folder of a data set."""


def main(options: argparse.Namespace) -> int:
    """Measure what the store does not have, unless a report is enough, and write the page; return 1
    if a job failed that can run here. With `check`, name the runs that look broken, and return 1 if
    there are any."""
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
    """The settings among `words`, and the data set that one of them names (data=DIR), if any does.

    Raises:
        SteerbenchError: another one names a scene; or there are no scenes.
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
    """Run the jobs, equal ones once; return how many failed, of those that can run here.

    Of one scene after the other, all models are trained that can be trained side by side; then all
    lines of all tables are measured with the first seed, then with the next.
    """
    distinct = {job.key: job for job in reversed(jobs)}
    jobs = [job for job in jobs if distinct[job.key] is job]
    of_scenes: dict[str, list[Planned]] = {}
    for job in jobs:
        of_scenes.setdefault(job.scene, []).append(job)
    seconds, measured, failed, ended = 0.0, 0, 0, 0
    for together in of_scenes.values():
        there: dict[str, Obtained] = {}
        if room(together[0].config) > 1:  # or else each job is looked up when its turn comes
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
            except Exception as error:  # it was printed: the other jobs still run
                failed += 0 if isinstance(error, Unavailable) else len(group)
                continue
            measured += sum(of_job.measured for of_job in obtained)
            seconds += time.monotonic() - begun
            left = time_left(seconds, measured, len(jobs) - ended)
            for job, of_job in zip(group, obtained, strict=True):
                say(of_job, job.name, left)
    return failed


def _obtained(group: Sequence[Planned], there: Mapping[str, Obtained]) -> list[Obtained]:
    """What is `there` of all jobs of a group, by their keys, or else is measured now."""
    if all(job.key in there for job in group):
        return [there[job.key] for job in group]
    wanted = [(job.config, job.command, job.name) for job in group]
    return attempt_in_turns(wanted, group[0].turns)


def _stored(group: Sequence[Planned]) -> list[Obtained]:
    """What the store has of all jobs of a group, or nothing; nothing, too, where one cannot even
    begin: measuring it says why."""
    try:
        return stored([(job.config, job.command) for job in group], group[0].turns)
    except SteerbenchError:
        return []


def _groups(jobs: Sequence[Planned]) -> list[list[Planned]]:
    """The jobs that are measured in turns, together; each of the others alone."""
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

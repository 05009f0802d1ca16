"""`steerbench paper` measures every table of the SteerNeRF paper as one page; `steerbench report`
writes the same page from the store alone."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from itertools import chain
from pathlib import Path

from bench.results import Store
from reports.outliers import outlier_table, outliers
from reports.paper_page import write_paper_page
from sweeps.jobs import attempt, say, time_left
from sweeps.overrides import composed
from sweeps.plan import Planned, chosen, gather, newest, plan
from sweeps.terminal import console, show


def main(options: argparse.Namespace) -> int:
    """Measure what the store does not have, unless a report is enough, and write the page; return 1
    if a job failed. With `check`, name the runs that look broken, and return 1 if there are any."""
    if options.command == "report" and options.check:
        return _check(Store(Path(composed(options.overrides).outputs)))
    tables = chosen(options.table, options.methods)
    jobs = [job for table in tables for job in plan(table, options.overrides)]
    failed = _run(jobs) if options.command == "paper" else 0
    outputs = Path(jobs[0].config.outputs)
    runs = newest(Store(outputs))
    found = outliers(list(chain(*runs.values())))
    folder = options.report or outputs / "paper"
    page = write_paper_page(tables, gather(jobs, runs, outputs), found, folder)
    print(f"report: {page}", file=sys.stderr)
    return int(failed > 0)


def _run(jobs: Sequence[Planned]) -> int:
    """Run one job after the other, equal ones once; return how many failed."""
    distinct = {job.key: job for job in reversed(jobs)}
    jobs = [job for job in jobs if distinct[job.key] is job]
    begun, measured, failed = time.monotonic(), 0, 0
    for number, job in enumerate(jobs, 1):
        print(f"{number} of {len(jobs)}, {job.name}", file=sys.stderr)
        try:
            obtained = attempt(job.config, job.command, job.name)
        except Exception:  # which `attempt` has printed: the other jobs still run
            failed += 1
            continue
        measured += obtained.measured
        say(obtained, job.name, time_left(time.monotonic() - begun, measured, len(jobs) - number))
    return failed


def _check(store: Store) -> int:
    runs = list(chain(*newest(store).values()))
    found = outliers(runs)
    if found:
        show(outlier_table(found, runs))
    broken = len({outlier.key for outlier in found})
    console().print(f"{broken} of {len(runs)} runs look broken")
    return int(len(found) > 0)

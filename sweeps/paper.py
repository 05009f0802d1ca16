"""`steerbench paper`: every table of the SteerNeRF paper, measured, as one page."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence

from sweeps.jobs import attempt, say, time_left
from sweeps.plan import Planned, chosen, plan
from sweeps.report import write


def main(options: argparse.Namespace) -> int:
    """Measure what the store does not have yet, then write the page; 1 if a job failed."""
    tables = chosen(options.table, options.methods)
    jobs = [job for table in tables for job in plan(table, options.overrides)]
    failed = _run(jobs)
    write(tables, jobs, options.report)
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
        left = time_left(time.monotonic() - begun, measured, len(jobs) - number)
        say(obtained, job.name, left)
    return failed

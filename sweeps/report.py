"""`steerbench report`: the page about the tables of the paper, from the store alone."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from itertools import chain
from pathlib import Path

from bench.results import Store
from reports.outliers import outlier_table, outliers
from reports.paper_page import write_paper_page
from reports.paper_tables import PaperTable
from sweeps.overrides import composed
from sweeps.plan import Planned, chosen, gather, newest, plan
from sweeps.terminal import console, show


def main(options: argparse.Namespace) -> int:
    """Write the page, or with `--check` name the broken rows of the store: 1 if there are any."""
    if options.check:
        return _check(Store(Path(composed(options.overrides).outputs)))
    tables = chosen(options.table, options.methods)
    jobs = [job for table in tables for job in plan(table, options.overrides)]
    write(tables, jobs, options.report)
    return 0


def write(tables: Sequence[PaperTable], jobs: Sequence[Planned], folder: Path | None) -> None:
    """Write the page about `tables` from the results of `jobs`, and print its path."""
    outputs = Path(jobs[0].config.outputs)
    runs = newest(Store(outputs))
    lines, found = gather(jobs, runs, outputs), outliers(list(chain(*runs.values())))
    page = write_paper_page(tables, lines, found, folder or outputs / "paper")
    print(f"report: {page}", file=sys.stderr)


def _check(store: Store) -> int:
    runs = list(chain(*newest(store).values()))
    found = outliers(runs)
    if found:
        show(outlier_table(found, runs))
    broken = len({outlier.key for outlier in found})
    console().print(f"{broken} of {len(runs)} runs look broken")
    return int(len(found) > 0)

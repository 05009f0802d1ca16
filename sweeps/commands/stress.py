"""`steerbench stress`: runs all cases with every backend, engine and precision."""

import argparse
import math
from collections.abc import Iterable, Iterator
from itertools import groupby
from pathlib import Path

import torch

from bench.case import failed, run_cases
from bench.console import ConsoleLog
from bench.errors import SteerbenchError
from methods import checks
from reports.tables import Table
from sweeps.commands.kernels import Row, errors
from sweeps.terminal import print_rows, show

COLUMNS = (
    *("subject", "case", "what must hold", "by", "on", "precision"),
    *("worst", "at most", "status"),
)
NEAREST = 5  # cases that are also shown by themselves


def main(options: argparse.Namespace) -> int:
    """Print a table, then its rows as JSON in the last line; return 1 if anything fails."""
    cases = [c for c in checks.found("cases") if options.filter in f"{c.subject}, {c.name}"]
    if not cases:
        raise SteerbenchError(f"--filter: no subject or case has {options.filter!r} in it")
    devices = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
    rows = list(run_cases(cases, devices, ConsoleLog(Path())))
    wrong = sum(failed(row) for row in rows)
    title = f"Stress: {len(cases)} cases, {len(rows)} cells, {wrong} failed"
    show(Table(title, COLUMNS, tuple(map(_line, rows))))
    nearest = sorted(_worst_of_cases(rows), key=_nearness, reverse=True)[:NEAREST]
    title = "Nearest to their tolerances"
    show(Table(title, COLUMNS, tuple(map(_line, nearest))))
    print_rows(rows)
    return int(wrong > 0)


def _line(row: Row) -> tuple[str, ...]:
    labels = ("subject", "case", "holds", "backend", "device", "precision")
    seen, at_most = errors(row)
    worst = "" if row["status"].startswith("unavailable") else seen
    return (*(row[name] for name in labels), worst, at_most, row["status"])


def _worst_of_cases(rows: Iterable[Row]) -> Iterator[Row]:
    """Of each case the cell that is nearest to its tolerance or exceeds it."""
    for _, cells in groupby(rows, key=lambda row: (row["subject"], row["case"])):
        yield max(cells, key=_nearness)


def _nearness(row: Row) -> float:
    if row["status"].startswith("unavailable"):
        return -1.0
    if failed(row):
        return math.inf
    return row["error"] / row["tolerance"] if row["tolerance"] else 0.0

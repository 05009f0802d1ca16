"""`steerbench experiments`: run time against error of kernels whose exact answer is known."""

import argparse
import math
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

from bench.console import ConsoleLog
from bench.convergence import experiment_rows
from methods import checks
from reports.tables import Table, decimal
from sweeps.processes import device_lock
from sweeps.terminal import print_rows, show

COLUMNS = ("computed", "knob", "setting", "largest error ↓", "ms ↓", "observed order")

Row = dict[str, Any]


def main(options: argparse.Namespace) -> int:
    """Print a table, then its rows as JSON in the last line."""
    with device_lock("cpu", log := ConsoleLog(Path())):
        rows = experiment_rows(checks.found("experiments"), options.repeats, log)
    show(_table(rows))
    print_rows(rows)
    return 0


def _table(rows: Sequence[Row]) -> Table:
    """One line per experiment: its first and last setting, and the observed order."""
    lines = []
    for subject, some in groupby(rows, lambda row: row["subject"]):
        first, *others = some
        ends = [first, *others[-1:]]
        order = ""
        if first["order"] is not None:
            span = f"{_setting(first['order_from'])} to {_setting(first['order_to'])}"
            order = f"{first['order']:.2f} ({span})"
        figures = zip(*map(_trial, ends), strict=True)
        lines.append((subject, first["knob"], *map(" to ".join, figures), order))
    title = "Run time against error, where the exact answer is known"
    return Table(title, COLUMNS, tuple(lines))


def _trial(row: Row) -> tuple[str, str, str]:
    return _setting(row["setting"]), f"{row['error']:.1e}", decimal(row["ms"], 2)


def _setting(value: float | str) -> str:
    """A short number, with powers of two below 1 as fractions; text is unchanged."""
    if isinstance(value, str):
        return value
    if 0 < value < 1 and math.frexp(value)[0] == 0.5:
        return f"1/{1 / value:.0f}"
    return f"{value:g}"

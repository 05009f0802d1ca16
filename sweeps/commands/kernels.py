"""`steerbench kernels`: error and throughput of every kernel; a wrong kernel is not timed."""

import argparse
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from bench.case import timed_rows
from bench.console import ConsoleLog
from bench.errors import SteerbenchError
from methods import checks
from methods.kernels import compiled
from methods.trial import tried_again
from reports.tables import Table, decimal
from sweeps.processes import device_lock
from sweeps.terminal import print_rows, show

COLUMNS = (
    *("kernel", "case", "backend", "dtype", "error", "tolerance"),
    *("M items/s", "ms", "by its reference", "ratio"),
)
"""`ratio`: time of the reference backend over time of this one, in the same case and run."""

Row = dict[str, Any]


def main(options: argparse.Namespace) -> int:
    """Print a table, then its rows as JSON in the last line; return 1 if any kernel is wrong."""
    log, device = ConsoleLog(Path()), "cuda" if torch.cuda.is_available() else "cpu"
    cases = [case for case in checks.found("cases") if options.filter in case.subject]
    if not cases:
        raise SteerbenchError(f"--filter: no kernel has {options.filter!r} in its name")
    with device_lock("auto", log):
        if device == "cuda" and "gpu" in compiled(device):
            tried_again("cuda:0", log)
        rows = timed_rows(cases, device, compiled(device), options.repeats, log)
    show(Table("Kernels", COLUMNS, tuple(map(_line, _saving_most_first(rows)))))
    print_rows(rows)
    return int(any(row["status"] != "ok" for row in rows))


def _saving_most_first(rows: Sequence[Row]) -> list[Row]:
    """What is wrong, then the fast versions, each with the time of its reference."""

    def computed(row: Row) -> tuple[str, ...]:
        return row["kernel"], row["case"], row["dtype"]

    reference_ms = {computed(row): row.get("ms") for row in rows if row["backend"] == "reference"}
    shown = (row for row in rows if row["backend"] != "reference" or row["status"] != "ok")
    compared = [{**row, "reference_ms": reference_ms.get(computed(row))} for row in shown]
    return sorted(compared, key=lambda row: row.get("ms", -math.inf) - (row["reference_ms"] or 0.0))


def _line(row: Row) -> tuple[str, ...]:
    labels = (row["kernel"], row["case"], row["backend"], row["dtype"], *errors(row))
    if row["status"] != "ok":
        return (*labels, "", row["status"], "", "")
    ratio = f"{row['ratio']:.1f}x" if "ratio" in row else ""
    times = (decimal(row[name], 2) for name in ("mitems_s", "ms", "reference_ms"))
    return (*labels, *times, ratio)


def errors(row: Row) -> tuple[str, str]:
    """The cells of the error of a check and of its tolerance."""
    error = "not finite" if row["error"] is None else f"{row['error']:.1e}"
    return error, "" if row["tolerance"] is None else f"{row['tolerance']:.1e}"

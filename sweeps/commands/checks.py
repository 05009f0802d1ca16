"""Checks of the code itself: `steerbench kernels`, error and throughput of every kernel;
`steerbench stress`, all cases with every backend, engine and precision; `steerbench experiments`,
run time against error where the exact answer is known.

Each prints a table, then its rows as JSON in the last line.
"""

import argparse
import math
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

import torch

from bench.case import failed, run_cases, timed_rows
from bench.console import ConsoleLog
from bench.convergence import experiment_rows
from bench.errors import SteerbenchError
from bench.kinds import Row, Rows
from methods import checks
from methods.kernels import compiled
from methods.trial import tried_again
from reports.tables import Table, decimal
from sweeps.processes import device_lock
from sweeps.terminal import print_rows, show

KERNELS = (
    *("kernel", "case", "backend", "dtype", "error", "tolerance"),
    *("M items/s", "ms", "by its reference", "ratio"),
)
"""`ratio`: time of the reference backend over time of this one, in the same case and run."""

STRESS = (
    *("subject", "case", "what must hold", "by", "on", "precision"),
    *("worst", "at most", "status"),
)
NEAREST = 5  # cases of `stress` that are also shown by themselves

EXPERIMENTS = ("computed", "knob", "setting", "largest error ↓", "ms ↓", "observed order")

Cells = tuple[str, ...]  # of a line of a table


def main(options: argparse.Namespace) -> int:
    """Do what `options.command` says; return 1 if anything is wrong."""
    command = {"kernels": _kernels, "stress": _stress, "experiments": _experiments}
    return command[options.command](options, ConsoleLog(Path()))


def _kernels(options: argparse.Namespace, log: ConsoleLog) -> int:
    """A kernel that is wrong is not timed."""
    device = "cuda" if torch.cuda.is_available() else "cpu"
    cases = [case for case in checks.found("cases") if options.filter in case.subject]
    if not cases:
        raise SteerbenchError(f"--filter: no kernel has {options.filter!r} in its name")
    with device_lock("auto", log):
        if device == "cuda" and "gpu" in compiled(device):
            tried_again("cuda:0", log)
        rows = timed_rows(cases, device, compiled(device), options.repeats, log)
    show(Table("Kernels", KERNELS, list(map(_of_kernel, _saving_most_first(rows)))))
    print_rows(rows)
    return int(any(row["status"] != "ok" for row in rows))


def _saving_most_first(rows: Sequence[Row]) -> Rows:
    """What is wrong, then the fast versions, each with the time of its reference."""

    def computed(row: Row) -> Cells:
        return row["kernel"], row["case"], row["dtype"]

    reference_ms = {computed(row): row.get("ms") for row in rows if row["backend"] == "reference"}
    shown = (row for row in rows if row["backend"] != "reference" or row["status"] != "ok")
    compared = [{**row, "reference_ms": reference_ms.get(computed(row))} for row in shown]
    return sorted(compared, key=lambda row: row.get("ms", -math.inf) - (row["reference_ms"] or 0.0))


def _of_kernel(row: Row) -> Cells:
    labels = (row["kernel"], row["case"], row["backend"], row["dtype"], *_errors(row))
    if row["status"] != "ok":
        return (*labels, "", row["status"], "", "")
    ratio = f"{row['ratio']:.1f}x" if "ratio" in row else ""
    times = (decimal(row[name], 2) for name in ("mitems_s", "ms", "reference_ms"))
    return (*labels, *times, ratio)


def _errors(row: Row) -> tuple[str, str]:
    """The cells of the error of a check and of its tolerance."""
    error = "not finite" if row["error"] is None else f"{row['error']:.1e}"
    return error, "" if row["tolerance"] is None else f"{row['tolerance']:.1e}"


def _stress(options: argparse.Namespace, log: ConsoleLog) -> int:
    cases = [c for c in checks.found("cases") if options.filter in f"{c.subject}, {c.name}"]
    if not cases:
        raise SteerbenchError(f"--filter: no subject or case has {options.filter!r} in it")
    devices = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
    rows = list(run_cases(cases, devices, log))
    wrong = sum(failed(row) for row in rows)
    title = f"Stress: {len(cases)} cases, {len(rows)} cells, {wrong} failed"
    of_cases = groupby(rows, key=lambda row: (row["subject"], row["case"]))
    worst = (max(cells, key=_nearness) for _, cells in of_cases)
    nearest = sorted(worst, key=_nearness, reverse=True)[:NEAREST]
    show(Table(title, STRESS, list(map(_of_case, rows))))
    show(Table("Nearest to their tolerances", STRESS, list(map(_of_case, nearest))))
    print_rows(rows)
    return int(wrong > 0)


def _of_case(row: Row) -> Cells:
    labels = ("subject", "case", "holds", "backend", "device", "precision")
    seen, at_most = _errors(row)
    worst = "" if row["status"].startswith("unavailable") else seen
    return (*(row[name] for name in labels), worst, at_most, row["status"])


def _nearness(row: Row) -> float:
    if row["status"].startswith("unavailable"):
        return -1.0
    if failed(row):
        return math.inf
    return row["error"] / row["tolerance"] if row["tolerance"] else 0.0


def _experiments(options: argparse.Namespace, log: ConsoleLog) -> int:
    with device_lock("cpu", log):
        rows = experiment_rows(checks.found("experiments"), options.repeats, log)
    title = "Run time against error, where the exact answer is known"
    experiments = groupby(rows, key=lambda row: row["subject"])
    show(Table(title, EXPERIMENTS, [_of_experiment(*some) for _, some in experiments]))
    print_rows(rows)
    return 0


def _of_experiment(first: Row, *others: Row) -> Cells:
    """Its first and last setting, and the observed order."""
    order = ""
    if first["order"] is not None:
        span = f"{_setting(first['order_from'])} to {_setting(first['order_to'])}"
        order = f"{first['order']:.2f} ({span})"
    ends = (first, *others[-1:])
    figures = [(_setting(x["setting"]), f"{x['error']:.1e}", decimal(x["ms"], 2)) for x in ends]
    joined = map(" to ".join, zip(*figures, strict=True))
    return (first["subject"], first["knob"], *joined, order)


def _setting(value: float | str) -> str:
    """A short number, with powers of two below 1 as fractions; text is unchanged."""
    if isinstance(value, str):
        return value
    if 0 < value < 1 and math.frexp(value)[0] == 0.5:
        return f"1/{1 / value:.0f}"
    return f"{value:g}"

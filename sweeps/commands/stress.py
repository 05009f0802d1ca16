"""`steerbench stress`: runs all cases with every backend, engine and precision."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterable, Iterator, Mapping
from itertools import groupby
from pathlib import Path
from typing import Any

import torch

from bench.case import failed, run_cases
from bench.console import ConsoleLog
from bench.errors import SteerbenchError
from methods import checks
from reports.tables import Table
from sweeps.commands.kernels import errors
from sweeps.terminal import print_rows, show

COLUMNS = (
    *("subject", "case", "what must hold", "by", "on", "precision"),
    *("worst", "at most", "status"),
)
CASE_COLUMNS = (
    *("subject", "case", "what must hold", "cells", "backend, precision"),
    *("worst", "at most", "status", "the tolerance"),
)
"""Columns with one line per case, which shows the cell nearest to its tolerance."""


def main(options: argparse.Namespace) -> int:
    """Print a table, then its rows as JSON in the last line; return 1 if anything fails."""
    cases = [c for c in checks.found("cases") if options.filter in f"{c.subject}, {c.name}"]
    if not cases:
        raise SteerbenchError(f"--filter: no subject or case has {options.filter!r} in it")
    devices = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
    rows = list(run_cases(cases, devices, ConsoleLog(Path())))
    wrong = sum(failed(row) for row in rows)
    title = f"Stress: {len(cases)} cases, {len(rows)} cells, {wrong} failed"
    if options.format == "markdown":
        print(Table(title, CASE_COLUMNS, tuple(_case_lines(rows)), figures=False).markdown())
    else:
        labels = ("subject", "case", "holds", "backend", "device", "precision")
        lines = tuple((*(row[name] for name in labels), *_end(row)) for row in rows)
        show(Table(title, COLUMNS, lines, figures=False))
    print_rows(rows)
    return int(wrong > 0)


def _end(row: Mapping[str, Any]) -> tuple[str, str, str]:
    """The cells of the columns "worst", "at most" and "status"."""
    seen, at_most = errors(row)
    return "" if row["status"].startswith("unavailable") else seen, at_most, row["status"]


def _case_lines(rows: Iterable[Mapping[str, Any]]) -> Iterator[tuple[str, ...]]:
    """One line per case, with the cell that is nearest to its tolerance or exceeds it."""
    for (subject, case), cells in groupby(rows, key=lambda row: (row["subject"], row["case"])):
        those = list(cells)
        worst = max(those, key=_nearness)
        by = f"{worst['backend']} {worst['precision']}"
        labels = (subject, case, worst["holds"], str(len(those)), by)
        yield (*labels, *_end(worst), worst["derivation"])


def _nearness(row: Mapping[str, Any]) -> float:
    if row["status"].startswith("unavailable"):
        return -1.0
    if failed(row):
        return math.inf
    return row["error"] / row["tolerance"] if row["tolerance"] else 0.0

"""`steerbench stress`: what must hold where numbers are extreme, and whether it does."""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bench.console import ConsoleLog
from bench.errors import SteerbenchError
from bench.stress import failed, run_cases
from reports.tables import Table
from sweeps.terminal import console, rich_table

COLUMNS = ("subject", "case", "what must hold", "by", "precision", "worst", "at most", "status")


def main(options: argparse.Namespace) -> int:
    """Print a table and, as the last line, the same rows as JSON; 1 if anything fails."""
    import torch

    from methods.stress import all_cases

    cases = [c for c in all_cases() if options.filter in f"{c.subject}, {c.name}"]
    if not cases:
        raise SteerbenchError(f"--filter: no subject or case has {options.filter!r} in it")
    device = "cuda" if torch.cuda.is_available() else "cpu"
    rows = list(run_cases(cases, device, ConsoleLog(Path())))
    wrong = sum(failed(row) for row in rows)
    title = f"Stress: {len(cases)} cases, {len(rows)} cells, {wrong} failed"
    table = Table(title, COLUMNS, tuple(_line(row) for row in rows), figures=False)
    if options.format == "markdown":
        print(table.markdown())
    else:
        console().print(rich_table(table))
    print(json.dumps(rows))
    return int(wrong > 0)


def _line(row: Mapping[str, Any]) -> tuple[str, ...]:
    labels = (row["subject"], row["case"], row["holds"], row["backend"], row["precision"])
    seen = "not finite" if row["error"] is None else f"{row['error']:.1e}"
    if row["status"].startswith("unavailable"):
        seen = ""
    return (*labels, seen, f"{row['tolerance']:.1e}", row["status"])

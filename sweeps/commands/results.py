"""`steerbench results`: prints every row of the store, for people or for programs."""

from __future__ import annotations

import argparse
import math
import sys

from bench.errors import unknown
from bench.results import existing_store
from reports.tables import NOT_AVAILABLE, Table
from sweeps.terminal import show

SHOWN = (
    *("run", "method", "scene", "trajectory", "device", "seed", "phase"),
    *("metric", "value", "lo", "hi", "n", "unit"),
)
"""The columns of the printed table; csv and json have all columns."""


def main(options: argparse.Namespace) -> int:
    """Print the rows below `options.outputs`, filtered if asked, as a table, csv or json."""
    store = existing_store(options.outputs)
    rows = store.rows(report=lambda message: print(message, file=sys.stderr))
    for column in ("method", "scene", "metric"):
        wanted = getattr(options, column)
        if wanted is not None:
            if wanted not in set(rows[column]):
                raise unknown(column, wanted, set(rows[column]))
            rows = rows[rows[column] == wanted]
    if options.format == "csv":
        rows.to_csv(sys.stdout, index=False)
    elif options.format == "json":
        rows.to_json(sys.stdout, orient="records", indent=1, double_precision=15)
        print()
    else:
        shown = rows.assign(run=rows["run"].str[:8])[list(SHOWN)]
        lines = tuple(tuple(map(_text, line)) for line in shown.itertuples(index=False))
        show(Table(str(options.outputs), SHOWN, lines))
    return 0


def _text(cell: object) -> str:
    if isinstance(cell, float):
        return NOT_AVAILABLE if math.isnan(cell) else f"{cell:.6g}"
    return str(cell)

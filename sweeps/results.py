"""`steerbench results`: every row of the store, for people or for programs."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path

import pandas as pd

from bench.errors import SteerbenchError
from bench.results import Store
from reports.tables import Table
from sweeps.names import unknown
from sweeps.terminal import console, rich_table

PEOPLE = (
    "run",
    "method",
    "scene",
    "trajectory",
    "seed",
    "metric",
    "value",
    "lo",
    "hi",
    "n",
    "unit",
)
"""The columns shown as a table; csv and json have all of them."""


def main(outputs: Path, form: str, chosen: Mapping[str, str | None]) -> int:
    """Print the rows below `outputs` as "table", "csv" or "json".

    Args:
        outputs: where runs are kept.
        form: one of the three.
        chosen: by column, the value that is wanted; None: all.

    Raises:
        SteerbenchError: nothing was measured, or nothing of what is wanted.
    """
    rows = Store(outputs).rows(report=lambda message: print(message, file=sys.stderr))
    if rows.empty:
        raise SteerbenchError(f"{outputs}: no runs yet; `steerbench run` makes one")
    for column, value in chosen.items():
        if value is not None:
            if value not in set(rows[column]):
                raise unknown(column, value, set(rows[column]))
            rows = rows[rows[column] == value]
    if form == "csv":
        rows.to_csv(sys.stdout, index=False)
    elif form == "json":
        rows.to_json(sys.stdout, orient="records", indent=1)
        print()
    else:
        console().print(rich_table(Table(str(outputs), PEOPLE, _lines(rows))))
    return 0


def _lines(rows: pd.DataFrame) -> tuple[tuple[str, ...], ...]:
    shown = rows.assign(run=rows["run"].str[:8])[list(PEOPLE)]
    return tuple(
        tuple(
            "n/a" if pd.isna(cell) else f"{cell:.6g}" if isinstance(cell, float) else str(cell)
            for cell in line
        )
        for line in shown.itertuples(index=False)
    )

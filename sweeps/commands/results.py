"""`steerbench results`: prints every row of the store, for people or for programs."""

import argparse
import math

from bench.errors import unknown
from bench.results import COLUMNS, existing_store
from reports.lines import results
from reports.tables import NOT_AVAILABLE, Table
from sweeps.terminal import note, show

SHOWN = (
    *("run", "method", "scene", "trajectory", "device", "seed", "phase"),
    *("metric", "value", "lo", "hi", "n", "unit"),
)
"""The columns of the printed table, beside settings that differ; csv and json have all columns."""


def main(options: argparse.Namespace) -> int:
    """Print the rows below `options.outputs`, filtered if asked, in the form that is asked for."""
    store = existing_store(options.outputs)
    rows = results(store, note)
    for column in ("method", "scene", "metric"):
        wanted = getattr(options, column)
        if wanted is not None:
            if wanted not in set(rows[column]):
                raise unknown(column, wanted, set(rows[column]))
            rows = rows[rows[column] == wanted]
    own = [str(name) for name in rows if name not in COLUMNS]
    columns = [*SHOWN[:2], *own, *SHOWN[2:]]
    short = rows.assign(run=rows["run"].str[:8])[columns]
    lines = short.map(_text).to_numpy().tolist()
    show(Table(str(options.outputs), columns, lines), rows, options.format)
    return 0


def _text(cell: object) -> str:
    if isinstance(cell, float):
        return NOT_AVAILABLE if math.isnan(cell) else f"{cell:.6g}"
    return str(cell)

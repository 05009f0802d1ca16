"""`steerbench parity`: error and time of the network for every engine and precision."""

from __future__ import annotations

import argparse

from bench.errors import SteerbenchError
from reports.tables import Table, decimal, megabytes
from sweeps.overrides import composed
from sweeps.terminal import print_rows, show
from sweeps.variants import (
    COMPARED,
    METHOD,
    compared,
    compared_cells,
    computes_with_engine,
    engines,
    render_variants,
    settings,
    settings_of,
)

COLUMNS = (
    *("engine, precision", *COMPARED, "p99 / p50 ↓"),
    *("worst pixel ↓", "network, ms ↓", "network, MB ↓"),
)


def main(options: argparse.Namespace) -> int:
    """Print a table, then its rows as JSON in the last line."""
    words, launcher = settings(options, METHOD, "trajectory=smooth")
    if not computes_with_engine(composed(words)):
        raise SteerbenchError(
            "steerbench parity compares the engines of a 2D renderer: expected a method with the "
            "setting method.engine, for example method=steernerf_lean or steernerf"
        )
    rendered = render_variants(settings_of(words, engines(words)), options, launcher)
    first = rendered[0]
    rows = [
        {
            "engine": each.name,
            **compared(each, first),
            "worst": each.values["worst"],
            "network_ms": each.network_ms,
            "bytes": each.bytes.get(each.study.network_size),
        }
        for each in rendered
    ]
    lines = (
        (
            row["engine"],
            *compared_cells(row),
            decimal(row["p99_to_p50"], 2),
            decimal(row["worst"], 4),
            decimal(row["network_ms"], 2),
            megabytes(row["bytes"]),
        )
        for row in rows
    )
    show(Table(f"{first.method}, {first.frames} frames", COLUMNS, tuple(lines)))
    print_rows(rows)
    return 0

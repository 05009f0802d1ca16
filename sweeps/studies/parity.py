"""`steerbench parity`: error and time of the network for every engine and precision."""

from __future__ import annotations

import argparse

from bench.errors import SteerbenchError
from reports.tables import Table, decimal, megabytes
from sweeps.overrides import composed
from sweeps.studies.variants import (
    COMPARED,
    METHOD,
    Row,
    compared,
    compared_cells,
    computes_with_engine,
    engines,
    print_rows,
    render_variants,
    settings_of,
)
from sweeps.terminal import show

COLUMNS = (
    *("engine, precision", *COMPARED, "p99 / p50 ↓"),
    *("worst pixel ↓", "network, ms ↓", "network, MB ↓"),
)


def main(options: argparse.Namespace) -> int:
    """Print a table, then its rows as JSON in the last line."""
    words = [METHOD, "trajectory=smooth", *options.overrides]
    if not computes_with_engine(composed(words)):
        raise SteerbenchError(
            "steerbench parity compares the engines of a 2D renderer: expected a method with the "
            "setting method.engine, for example method=steernerf_lean or steernerf"
        )
    variants = settings_of(words, engines(words))
    found = render_variants(variants, options.frames, options.repeats)
    rows = [
        {
            "engine": one.name,
            **compared(one, found[0]),
            "worst": one.values["worst"],
            "network_ms": one.network_ms,
            "bytes": one.method.sizes().get(one.study.network_size),
        }
        for one in found
    ]
    title = f"{found[0].method.name}, {found[0].frames} frames"
    show(Table(title, COLUMNS, tuple(_line(row) for row in rows)))
    print_rows(rows)
    return 0


def _line(row: Row) -> tuple[str, ...]:
    return (
        row["engine"],
        *compared_cells(row),
        decimal(row["p99_to_p50"], 2),
        decimal(row["worst"], 4),
        decimal(row["network_ms"], 2),
        megabytes(row["bytes"]),
    )

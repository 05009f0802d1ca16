"""`steerbench parity`: the error and the time of every engine and precision of the network."""

from __future__ import annotations

import argparse

from bench.errors import SteerbenchError
from reports.tables import Table, decimal, megabytes
from sweeps.overrides import composed
from sweeps.studies.variants import (
    METHOD,
    Rendered,
    Row,
    apart_text,
    computes_with_engine,
    engines,
    print_rows,
    range_text,
    render_variants,
    settings_of,
)
from sweeps.terminal import show

COLUMNS = (
    "engine, precision",
    "PSNR to torch fp32, dB ↑",
    "worst pixel ↓",
    "PSNR, dB ↑",
    "lost, dB ↓",
    "network, ms ↓",
    "frame, ms ↓",
    "of rounds",
    "p99 / p50",
    "network, MB ↓",
)


def main(options: argparse.Namespace) -> int:
    """Print a table and, as the last line, the same rows as JSON."""
    words = [METHOD, "trajectory=smooth", *options.overrides]
    if not computes_with_engine(composed(words)):
        raise SteerbenchError(
            "steerbench parity compares the engines of a 2D renderer: expected a method with the "
            "setting method.engine, for example method=steernerf_lean or steernerf"
        )
    variants = settings_of(words, engines(words))
    found = render_variants(variants, options.frames, options.repeats)
    rows = [_row(one, found[0]) for one in found]
    title = f"{found[0].method.name}, {found[0].frames} frames"
    show(Table(title, COLUMNS, tuple(_line(row) for row in rows)))
    print_rows(rows)
    return 0


def _row(one: Rendered, standard: Rendered) -> Row:
    values = one.values
    return {
        "engine": one.name,
        "apart": values["psnr_to_first"],
        "worst": values["worst"],
        "psnr": values["psnr"],
        "lost": standard.values["psnr"] - values["psnr"],
        "network_ms": one.network_ms,
        "frame_ms": values["ms"],
        **{name: values[name] for name in ("ms_lo", "ms_hi", "p99_to_p50")},
        "bytes": one.method.sizes().get(one.study.network_size),
    }


def _line(row: Row) -> tuple[str, ...]:
    return (
        row["engine"],
        apart_text(row["apart"]),
        decimal(row["worst"], 4),
        decimal(row["psnr"], 2),
        decimal(row["lost"], 3),
        decimal(row["network_ms"], 2),
        decimal(row["frame_ms"], 1),
        range_text(row),
        decimal(row["p99_to_p50"], 2),
        megabytes(row["bytes"]),
    )

"""`steerbench parity`: what every engine and precision of the 2D renderer loses, and saves."""

from __future__ import annotations

import argparse
import json
from typing import Any

from bench.errors import SteerbenchError
from reports.tables import Table, decimal, megabytes
from sweeps.overrides import composed
from sweeps.terminal import console, rich_table
from sweeps.variants import (
    Rendered,
    apart_text,
    engines,
    finite,
    range_text,
    render_variants,
    settings_of,
)

SETTINGS = ("method=steernerf", "trajectory=smooth")

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
    overrides = [*SETTINGS, *options.overrides]
    if "engine" not in composed(overrides).method:
        raise SteerbenchError(
            "steerbench parity compares engines of a 2D renderer: expected method=steernerf or "
            "steernerf_paper"
        )
    variants = settings_of(overrides, engines())
    found = render_variants(variants, options.frames, options.repeats)
    rows = [_row(one, found[0]) for one in found]
    title = f"{found[0].method.name}, {found[0].frames} frames"
    console().print(rich_table(Table(title, COLUMNS, tuple(_line(row) for row in rows))))
    print(json.dumps([finite(row) for row in rows]))
    return 0


def _row(one: Rendered, standard: Rendered) -> dict[str, Any]:
    return {
        "engine": one.name,
        "apart": one.values["psnr_to_first"],
        "worst": one.values["worst"],
        "psnr": one.values["psnr"],
        "lost": standard.values["psnr"] - one.values["psnr"],
        "network_ms": one.values["stage_ms.renderer2d/network"],
        "frame_ms": one.values["ms"],
        "ms_lo": one.values["ms_lo"],
        "ms_hi": one.values["ms_hi"],
        "p99_to_p50": one.values["p99_to_p50"],
        "bytes": one.method.sizes()["renderer2d"],
    }


def _line(row: dict[str, Any]) -> tuple[str, ...]:
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

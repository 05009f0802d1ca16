"""`steerbench skips`: what is not computed, what that saves, and what it adds in error."""

from __future__ import annotations

import argparse
import json
from typing import Any

from reports.tables import Table, decimal, share
from sweeps.overrides import composed
from sweeps.terminal import console, rich_table
from sweeps.variants import (
    Rendered,
    Variant,
    apart_text,
    finite,
    range_text,
    render_variants,
    reprojects_exactly,
    require_lean,
    settings_of,
)

SETTINGS = ("method=steernerf", "trajectory=smooth", "method.pipeline.refined=0")
"""Without refinement, which takes a share of the cells that are drawn: of more where nothing is
skipped."""

SWITCHES = {"empty space": "empty", "hidden samples": "hidden", "background cells": "background"}
"""The settings below `method.pipeline.skip`, in words."""

NOTHING_SKIPPED = tuple(f"method.pipeline.skip.{switch}=false" for switch in SWITCHES.values())

WORK = ("rays", "samples", "shaded", "table reads, M", "cells", "products, G")

COLUMNS = (
    "skipped",
    "PSNR to nothing skipped, dB ↑",
    "PSNR, dB ↑",
    "lost, dB ↓",
    "frame, ms ↓",
    "of rounds",
)


def main(options: argparse.Namespace) -> int:
    """Print a table and, as the last line, the same rows as JSON."""
    overrides = [*SETTINGS, *options.overrides]
    config = composed(overrides)
    require_lean(config, "steerbench skips counts the work of a network on cells")
    variants = settings_of(overrides, _variants(reprojects_exactly(config)))
    found = render_variants(variants, options.frames, options.repeats)
    rows = [_row(one, found[0]) for one in found]
    title = f"{found[0].method.name}, {found[0].frames} frames: mean work of a frame, and its share"
    lines = tuple(_line(row, rows[0]) for row in rows)
    console().print(rich_table(Table(title, (*COLUMNS, *WORK), lines)))
    print(json.dumps([finite(row) for row in rows]))
    return 0


def _variants(refresh: bool) -> list[Variant]:
    """Nothing skipped, each alone, all of them, and on top what the preceding frame knows."""
    taken_over = Variant("and rays taken over", ("method.pipeline.refresh.age=3",))
    off = dict(zip(SWITCHES, NOTHING_SKIPPED, strict=True))
    alone = [
        Variant(name, tuple(line for other, line in off.items() if other != name)) for name in off
    ]
    return [
        Variant("nothing", NOTHING_SKIPPED),
        *alone,
        Variant("all of these"),
        Variant("and a window of depths", ("method.pipeline.range.mode=window",)),
        *([taken_over] if refresh else []),
    ]


def _row(one: Rendered, standard: Rendered) -> dict[str, Any]:
    done = one.values
    surface = done.get("work.surface_samples", 0)
    work = (
        done["work.rays"] + done.get("work.refined_rays", 0),
        done["work.samples"] + surface,
        done["work.shaded_samples"] + surface,
        done["work.table_reads"] / 1e6,
        done["work.cells"],
        done["work.products"] / 1e9,
    )
    return {
        "skipped": one.name,
        "apart": done["psnr_to_first"],
        "psnr": done["psnr"],
        "lost": standard.values["psnr"] - done["psnr"],
        "frame_ms": done["ms"],
        "ms_lo": done["ms_lo"],
        "ms_hi": done["ms_hi"],
        **dict(zip(WORK, work, strict=True)),
    }


def _line(row: dict[str, Any], dense: dict[str, Any]) -> tuple[str, ...]:
    figures = (
        f"{decimal(row[name], 2 if ',' in name else 0)} ({share(row[name], dense[name])})"
        for name in WORK
    )
    return (
        row["skipped"],
        apart_text(row["apart"]),
        decimal(row["psnr"], 2),
        decimal(row["lost"], 3),
        decimal(row["frame_ms"], 1),
        range_text(row),
        *figures,
    )

"""`steerbench breakdown`: where the time of a frame goes, precision by precision."""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from typing import Any

from omegaconf import OmegaConf

from bench.probes import OTHER
from reports.tables import Table, decimal, share
from sweeps.overrides import composed
from sweeps.skips import NOTHING_SKIPPED
from sweeps.terminal import console, rich_table
from sweeps.variants import (
    Rendered,
    Variant,
    engines,
    finite,
    range_text,
    render_variants,
    require_lean,
    settings_of,
)

Row = dict[str, Any]

AHEAD, DENSE, UNET, NGP = (
    ", next camera known",
    ", nothing skipped",
    ", the paper's",
    "Instant-NGP",
)
"""How the names of the other variants of an engine at a precision end; the last is whole."""

SETTINGS = ("method=steernerf", "trajectory=smooth", "engine=openvino")

PAPER = ("method=steernerf_paper", "budget.renderer_steps=8")
"""The U-Net of the release. What it has learned does not change what it costs."""

PART_OF = {
    "field": "field",
    "depth_reprojection": "reprojection",
    "rays": "field",
    "march": "field",
    "composite": "field",
    "feature_reprojection": "reprojection",
    "feature_reprojection/surface": "surface",
    "renderer2d": "renderer2d",
    "renderer2d/network": "network",
    "refinement": "refinement",
    "finish": "finish",
    "lookahead": "lookahead",
}
"""The part that a stage is, with all within it that is no part of its own."""

PARTS = (*dict.fromkeys(PART_OF.values()), OTHER)

COLUMNS = ("", *PARTS, "frame ↓", "of rounds", "latency ↓", "p99 / p50 ↓", "FPS ↑", "PSNR, dB ↑")

COMPARED = (
    "",
    "frame of Instant-NGP / frame ↑",
    "the paper's network / frame ↑",
    "the paper's network / network ↑",
    "lost to fp32, dB ↓",
    "lost by skipping, dB ↓",
    "time, of nothing skipped ↓",
)


def main(options: argparse.Namespace) -> int:
    """Print two tables and, as the last line, the rows of the first as JSON."""
    overrides = [*SETTINGS, *options.overrides, "protocol.lookahead=false"]
    config = composed(overrides)
    require_lean(config, "steerbench breakdown switches off what a network on cells can skip")
    choice = composed(overrides, return_hydra_config=True).hydra.runtime.choices.engine
    usual = [variant for variant in engines() if f"engine={choice}" in variant.settings]
    shared = of_stage_1(overrides)
    variants = {
        **settings_of(overrides, usual),
        **settings_of([*overrides, "protocol.lookahead=true"], _called(usual, AHEAD)),
        **settings_of([*overrides, *NOTHING_SKIPPED], _called(usual, DENSE)),
        **settings_of([*shared, *PAPER], _called(usual, UNET)),
        NGP: [*shared, "method=ngp"],
    }
    found = render_variants(variants, options.frames, options.repeats)
    rows = {one.name: _row(one) for one in found}
    names = [variant.name for variant in usual if variant.name in rows]
    compared = [_compared(rows, name, names[0]) for name in names]
    title = f"ms of a frame, and what of it each part takes itself; {found[0].frames} frames"
    console().print(rich_table(Table(title, COLUMNS, tuple(map(_line, rows.values())))))
    console().print(rich_table(Table("Compared", COMPARED, tuple(compared))))
    print(json.dumps([finite(row) for row in rows.values()]))
    return 0


def of_stage_1(overrides: Sequence[str]) -> list[str]:
    """Those of `overrides` that decide what the field of stage 1 is, and all that are not of the
    method: what Instant-NGP has, too."""
    ngp, missing = composed(["method=ngp"]), object()
    return [
        override
        for override in overrides
        if not (name := override.partition("=")[0].lstrip("+~")).startswith("method")
        or ("." in name and OmegaConf.select(ngp, name, default=missing) is not missing)
    ]


def part_of(stage: str) -> str:
    """The part of a frame that a `stage` is counted in."""
    while stage:
        if stage in PART_OF:
            return PART_OF[stage]
        stage, _, _ = stage.rpartition("/")
    return OTHER


def _called(variants: Sequence[Variant], ending: str) -> list[Variant]:
    return [Variant(variant.name + ending, variant.settings) for variant in variants]


def _row(one: Rendered) -> Row:
    parts = dict.fromkeys(PARTS, 0.0)
    for metric, value in one.values.items():
        if metric.startswith("stage_ms."):
            parts[part_of(metric.removeprefix("stage_ms."))] += value
    return {
        "line": one.name,
        **parts,
        "frame_ms": one.values["ms"],
        "ms_lo": one.values["ms_lo"],
        "ms_hi": one.values["ms_hi"],
        "latency_ms": one.values["latency_ms"],
        "p99_to_p50": one.values["p99_to_p50"],
        "psnr": None if one.name.endswith(UNET) else one.values["psnr"],
    }


def _line(row: Row) -> tuple[str, ...]:
    return (
        row["line"],
        *(decimal(row[part], 1) for part in PARTS),
        decimal(row["frame_ms"], 1),
        range_text(row),
        decimal(row["latency_ms"], 1),
        decimal(row["p99_to_p50"], 2),
        decimal(1e3 / row["frame_ms"], 2),
        decimal(row["psnr"], 2),
    )


def _compared(rows: Mapping[str, Row], name: str, standard: str) -> tuple[str, ...]:
    """What skipping and a lean network bring the line `name`; `standard` is that of fp32."""
    lean, dense, unet = (rows[name + ending] for ending in ("", DENSE, UNET))
    return (
        name,
        decimal(rows[NGP]["frame_ms"] / lean["frame_ms"], 1),
        decimal(unet["network"] / lean["frame_ms"], 1),
        decimal(unet["network"] / lean["network"], 1),
        decimal(rows[standard]["psnr"] - lean["psnr"], 3),
        decimal(dense["psnr"] - lean["psnr"], 3),
        share(lean["frame_ms"], dense["frame_ms"]),
    )

"""`steerbench breakdown`: where the time of a frame goes, precision by precision."""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from typing import Any

from hydra.utils import get_class
from omegaconf import OmegaConf

from reports.tables import Table, number, share
from sweeps.overrides import composed
from sweeps.skips import NOTHING_SKIPPED
from sweeps.terminal import console, rich_table
from sweeps.variants import (
    Rendered,
    Variant,
    engines,
    finite,
    render_variants,
    require_lean,
    settings_of,
)

Row = dict[str, Any]

DENSE, UNET, NGP = ", nothing skipped", ", the paper's U-Net", "Instant-NGP"
"""How the names of lines end that are not of one engine at one precision as it is; the last is
whole."""

SETTINGS = ("method=steernerf", "trajectory=smooth", "engine=openvino")

PAPER = ("method=steernerf_paper", "budget.renderer_steps=8")
"""The U-Net of the release. What it has learned does not change what it costs."""

PARTS = {
    "depth_reprojection": "reprojection",
    "field": "field",
    "rays": "field",
    "march": "field",
    "composite": "field",
    "feature_reprojection": "reprojection",
    "feature_reprojection/surface": "surface",
    "renderer2d": "renderer2d",
    "renderer2d/network": "network",
    "refinement": "refinement",
}
"""The column of a stage, and of all within it that has none of its own."""

REST = "rest"
COLUMNS = ("field", "reprojection", "surface", "renderer2d", "network", "refinement", REST)
HEADS = ("", *COLUMNS, "frame ↓", "p99 / p50 ↓", "FPS ↑", "PSNR, dB ↑")

RATIOS = (
    "",
    "Instant-NGP / frame ↑",
    "the paper's U-Net / frame ↑",
    "the paper's U-Net / network ↑",
    "lost to fp32, dB ↓",
    "lost by skipping, dB ↓",
    "time, of nothing skipped ↓",
)


def main(options: argparse.Namespace) -> int:
    """Print two tables and, as the last line, the rows of the first as JSON."""
    overrides = [*SETTINGS, *options.overrides]
    config = composed(overrides)
    require_lean(config, "steerbench breakdown switches off what a network on cells can skip")
    kind: Any = get_class(config.engine._target_)
    engine = f"engine={kind.name}"
    shared = of_the_field(overrides)
    usual = [variant for variant in engines() if engine in variant.settings]
    lines = {
        **settings_of(overrides, usual),
        **settings_of([*overrides, *NOTHING_SKIPPED], _called(usual, DENSE)),
        **settings_of([*shared, *PAPER], _called(usual, UNET)),
        NGP: [*shared, "method=ngp"],
    }
    found = render_variants(lines, options.frames, options.repeats)
    rows = {one.name: _row(one) for one in found}
    names = [variant.name for variant in usual if variant.name in rows]
    compared = [_ratios(rows, name, names[0]) for name in names]
    title = f"ms of a frame, part by part, mean of the steady ones of {found[0].frames}"
    console().print(rich_table(Table(title, HEADS, tuple(map(_line, rows.values())))))
    console().print(rich_table(Table("Compared", RATIOS, tuple(compared))))
    print(json.dumps([finite(row) for row in rows.values()]))
    return 0


def of_the_field(overrides: Sequence[str]) -> list[str]:
    """Those of `overrides` that Instant-NGP has, too: the same field for all."""
    ngp = composed(["method=ngp"])
    return [
        override
        for override in overrides
        if not (name := override.partition("=")[0].lstrip("+~")).startswith("method")
        or ("." in name and OmegaConf.select(ngp, name, default=REST) != REST)
    ]


def part_of(stage: str) -> str:
    """The column of a `stage`."""
    while stage:
        if stage in PARTS:
            return PARTS[stage]
        stage, _, _ = stage.rpartition("/")
    return REST


def _called(variants: Sequence[Variant], ending: str) -> list[Variant]:
    return [Variant(variant.name + ending, variant.settings) for variant in variants]


def _row(one: Rendered) -> Row:
    parts = dict.fromkeys(COLUMNS, 0.0)
    for metric, value in one.values.items():
        if metric.startswith("stage_ms."):
            parts[part_of(metric.removeprefix("stage_ms."))] += value
    return {
        "line": one.name,
        **parts,
        "frame_ms": one.values["ms"],
        "p99_to_p50": one.values["p99_to_p50"],
        "psnr": None if one.name.endswith(UNET) else one.values["psnr"],
    }


def _line(row: Row) -> tuple[str, ...]:
    return (
        row["line"],
        *(number(row[part], 1) for part in COLUMNS),
        number(row["frame_ms"], 1),
        number(row["p99_to_p50"], 2),
        number(1e3 / row["frame_ms"], 2),
        number(row["psnr"], 2),
    )


def _ratios(rows: Mapping[str, Row], name: str, standard: str) -> tuple[str, ...]:
    """What skipping and a lean network bring the line `name`; `standard` is that of fp32."""
    lean, dense, unet = (rows[name + ending] for ending in ("", DENSE, UNET))
    return (
        name,
        number(rows[NGP]["frame_ms"] / lean["frame_ms"], 1),
        number(unet["network"] / lean["frame_ms"], 1),
        number(unet["network"] / lean["network"], 1),
        number(rows[standard]["psnr"] - lean["psnr"], 3),
        number(dense["psnr"] - lean["psnr"], 3),
        share(lean["frame_ms"], dense["frame_ms"]),
    )

"""`steerbench breakdown`: where the time of a frame goes, precision by precision."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from itertools import chain
from typing import Any

from hydra.utils import get_class
from omegaconf import OmegaConf

from reports.tables import Table, number, share
from sweeps.overrides import composed
from sweeps.skips import NOTHING_SKIPPED
from sweeps.terminal import console, rich_table
from sweeps.variants import Rendered, Variant, engines, finite, render_variants, require_lean

Row = dict[str, Any]

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
    "renderer2d": "around it",
    "renderer2d/network": "network",
    "refinement": "refinement",
}
"""The column of a stage, and of all within it that has none of its own."""

REST = "rest"
COLUMNS = ("field", "reprojection", "surface", "network", "around it", "refinement", REST)
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
    everywhere = of_the_field(overrides)

    def rendered(label: str, own: Sequence[str], variants: Sequence[Variant]) -> list[Rendered]:
        return render_variants(own, variants, options.frames, label)

    precisions = [variant for variant in engines() if engine in variant.settings]
    lean = rendered("precisions", overrides, precisions)
    usable = [one.variant for one in lean]
    dense = rendered("nothing skipped", [*overrides, *NOTHING_SKIPPED], usable)
    unet = rendered("the paper's U-Net", [*everywhere, *PAPER], usable)
    ngp = rendered("Instant-NGP", [*everywhere, "method=ngp"], [Variant("Instant-NGP")])

    lines = [
        [_row(one, "") for one in lean],
        [_row(one, ", nothing skipped") for one in dense],
        [_row(one, ", the paper's U-Net") | {"psnr": None} for one in unet],
    ]
    alone = _row(ngp[0], "")
    compared = [_ratios(alone, lines[0][0], *three) for three in zip(*lines, strict=True)]
    rows = [*chain(*lines), alone]
    title = f"ms of a frame, mean of the steady ones of {alone['frames']}"
    console().print(rich_table(Table(title, HEADS, tuple(map(_line, rows)))))
    console().print(rich_table(Table("Compared", RATIOS, tuple(compared))))
    print(json.dumps([finite(row) for row in rows]))
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


def _row(one: Rendered, label: str) -> Row:
    parts = dict.fromkeys(COLUMNS, 0.0)
    for metric, value in one.values.items():
        if metric.startswith("stage_ms."):
            parts[part_of(metric.removeprefix("stage_ms."))] += value
    ms = one.values["frame_ms"]
    return {
        "line": one.variant.name + label,
        **parts,
        "frame_ms": ms,
        "p99_to_p50": one.values["frame_ms.p99"] / one.values["frame_ms.p50"],
        "psnr": one.values["psnr"],
        "frames": one.frames,
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


def _ratios(ngp: Row, standard: Row, lean: Row, dense: Row, unet: Row) -> tuple[str, ...]:
    """What skipping and a lean network bring at one precision; `standard` is fp32."""
    return (
        lean["line"],
        number(ngp["frame_ms"] / lean["frame_ms"], 1),
        number(unet["network"] / lean["frame_ms"], 1),
        number(unet["network"] / lean["network"], 1),
        number(standard["psnr"] - lean["psnr"], 3),
        number(dense["psnr"] - lean["psnr"], 3),
        share(lean["frame_ms"], dense["frame_ms"]),
    )

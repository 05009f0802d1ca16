"""Plots of measured rows. Drawn without a display and without global state."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import ScalarFormatter
from numpy.typing import ArrayLike

from reports.runs import Run

STAGE = "stage_ms."
LEGEND_COLUMNS = 6
COLOURS = [matplotlib.colormaps["tab20"](index) for index in (*range(0, 20, 2), *range(1, 20, 2))]
COLOURS = [colour for colour in COLOURS if len(set(colour[:3])) > 1]  # grey is for "other"

MARKERS = "s*ovDP^X<>ph"


def stage_bars(runs: Sequence[Run], path: Path) -> None:
    """Write a PNG: one bar per run, its mean frame time in ms divided into stages.

    A stage has one colour in all bars; what lies in no stage is grey and comes last.
    """
    stages = list(dict.fromkeys(name for run in runs for name in run.values if _is_stage(name)))
    stages.sort(key=lambda name: name == f"{STAGE}other")
    legend_lines = -(-len(stages) // LEGEND_COLUMNS)
    height = 0.7 + 0.25 * legend_lines + 0.5 * len(runs)
    figure = Figure(figsize=(8, height), layout="constrained")
    axes = figure.subplots()
    ends = [0.0] * len(runs)
    for number, stage in enumerate(stages):
        widths = [run.values.get(stage, 0.0) for run in runs]
        name = stage.removeprefix(STAGE)
        colour = "lightgrey" if name == "other" else COLOURS[number % len(COLOURS)]
        axes.barh(range(len(runs)), widths, left=ends, height=0.6, label=name, color=colour)
        ends = [end + width for end, width in zip(ends, widths, strict=True)]
    for line, end in enumerate(ends):
        axes.text(end, line, f" {end:.1f}", va="center")
    axes.set_xlim(0, 1.12 * max(ends))
    axes.set_yticks(range(len(runs)), [run.label for run in runs])
    axes.invert_yaxis()
    axes.set_xlabel("mean ms of a frame")
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside upper center", ncols=LEGEND_COLUMNS, frameon=False)
    figure.savefig(path, dpi=150)


def _is_stage(metric: str) -> bool:
    return metric.startswith(STAGE)


def frontier_plot(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Write a PNG: error of a frame against its time, log-log, a point for each setting.

    Beside each other the error against the ground truth, with the Pareto frontier, and that against
    the first row, which stands for everything off. A knob has one colour and marker.

    Args:
        rows: knob, setting, ms, ms_lo, ms_hi, psnr, psnr_to_first and instead: the setting itself
            on the frontier.
    """
    figure = Figure(figsize=(12, 6), layout="constrained")
    truth, off = figure.subplots(1, 2, sharex=True)
    knobs = list(dict.fromkeys(row["knob"] for row in rows))
    for axes, column in ((truth, "psnr"), (off, "psnr_to_first")):
        for number, knob in enumerate(knobs):
            some = [row for row in rows if row["knob"] == knob and math.isfinite(row[column])]
            ms, error = [row["ms"] for row in some], [_rms(row[column]) for row in some]
            spread = [
                [row["ms"] - row["ms_lo"] for row in some],
                [row["ms_hi"] - row["ms"] for row in some],
            ]
            look = {"color": COLOURS[number % len(COLOURS)], "fmt": MARKERS[number % len(MARKERS)]}
            axes.errorbar(ms, error, xerr=spread, label=knob, elinewidth=0.7, alpha=0.8, **look)
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_xlabel("ms of a frame (median of the rounds; bars: fastest and slowest round)")
        decibels = axes.secondary_yaxis("right", functions=(_psnr, _rms))
        decibels.set_ylabel("PSNR, dB")
        for axis in (axes.xaxis, axes.yaxis, decibels.yaxis):
            axis.set_major_formatter(ScalarFormatter())
            axis.set_minor_formatter(ScalarFormatter())
        axes.grid(which="both", color="0.92")
        axes.set_axisbelow(True)
    truth.set_ylabel("error of a pixel, root mean square, of 1")
    truth.set_title("against the ground truth: lower left is better")
    off.set_title("against the same model with everything off")
    _draw_frontier(truth, rows)
    figure.legend(*truth.get_legend_handles_labels(), loc="outside lower center", ncols=6)
    figure.savefig(path, dpi=110)


def _draw_frontier(axes: Axes, rows: Sequence[Mapping[str, Any]]) -> None:
    """A staircase through the settings that none beats, each with its name."""
    best = sorted((row for row in rows if row["instead"] == row["setting"]), key=lambda r: r["ms"])
    ms, error = [row["ms"] for row in best], [_rms(row["psnr"]) for row in best]
    axes.step(ms, error, where="post", color="black", linewidth=1, label="frontier")
    for row, x, y in zip(best, ms, error, strict=True):
        axes.annotate(
            row["setting"], (x, y), xytext=(-4, -10), textcoords="offset points", size=7, ha="right"
        )


def _rms(psnr: ArrayLike) -> np.ndarray:
    return 10 ** (-np.asarray(psnr) / 20)


def _psnr(rms: ArrayLike) -> np.ndarray:
    return -20 * np.log10(rms)

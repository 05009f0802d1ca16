"""Plots of measured rows. Drawn without a display and without global state."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator, ScalarFormatter

from bench.results import COLD
from reports.runs import Run
from reports.seeds import Repeated

STAGE = "stage_ms."
LEGEND_COLUMNS = 4
MARKERS = "osD^vP*X<>"
COLOURS = [matplotlib.colormaps["tab20"](index) for index in (*range(0, 20, 2), *range(1, 20, 2))]
COLOURS = [colour for colour in COLOURS if len(set(colour[:3])) > 1]  # grey is for "other"


def stage_bars(runs: Sequence[Run], path: Path) -> None:
    """Write a PNG: one bar per run, its mean frame time in ms divided into stages.

    A stage, which holds the stages inside it, has one colour in all bars; what lies in no stage is
    grey and comes last.
    """
    bars = [_stages(run) for run in runs]
    stages = list(dict.fromkeys(name for bar in bars for name in bar))
    stages.sort(key=lambda name: name == "other")
    legend_lines = -(-len(stages) // LEGEND_COLUMNS)
    height = 0.7 + 0.25 * legend_lines + 0.5 * len(runs)
    figure = Figure(figsize=(8, height), layout="constrained")
    axes = figure.subplots()
    ends = [0.0] * len(runs)
    for number, stage in enumerate(stages):
        widths = [bar.get(stage, 0.0) for bar in bars]
        colour = "lightgrey" if stage == "other" else COLOURS[number % len(COLOURS)]
        axes.barh(range(len(runs)), widths, left=ends, height=0.6, label=stage, color=colour)
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


def _stages(run: Run) -> dict[str, float]:
    """Mean ms of every stage, with the stages inside it."""
    stages: dict[str, float] = {}
    for name, ms in run.values.items():
        if name.startswith(STAGE):
            outermost = name.removeprefix(STAGE).partition("/")[0]
            stages[outermost] = stages.get(outermost, 0.0) + ms
    return stages


def quality_against(
    lines: Sequence[Repeated], metric: str, unit: float, axis: str, path: Path
) -> None:
    """Write a PNG: PSNR of each of `lines` against its `metric`, in `unit`, called `axis`.

    Both have the bars of their intervals where there are several seeds.
    """
    figure, axes = _quality(4.0, axis)
    for number, line in enumerate(lines):
        across, up = line.mean(metric), line.mean("psnr")
        if across is None or up is None:
            continue
        bars = [half if half > 0 else None for half in (line.half(metric), line.half("psnr"))]
        axes.errorbar(
            across / unit,
            up,
            xerr=bars[0] and bars[0] / unit,
            yerr=bars[1],
            fmt=MARKERS[number % len(MARKERS)],
            color=COLOURS[number % len(COLOURS)],
            markersize=8,
            label=line.label,
        )
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 3, 5, 7)))
    axes.xaxis.set_major_formatter(ScalarFormatter())
    axes.xaxis.set_minor_locator(NullLocator())
    figure.legend(loc="outside right upper", frameon=False)
    figure.savefig(path, dpi=150)


def quality_over_frames(runs: Sequence[Run], path: Path) -> None:
    """Write a PNG: PSNR of every frame with a ground truth along the path, a curve for each run;
    cold frames are hollow."""
    figure, axes = _quality(3.5, "frame of the path")
    for number, run in enumerate(runs):
        scored = run.frames.dropna(subset=["psnr"])
        colour, cold = COLOURS[number % len(COLOURS)], scored[scored["phase"] == COLD]
        axes.plot(scored["frame"], scored["psnr"], marker="o", color=colour, label=run.label)
        axes.plot(cold["frame"], cold["psnr"], "o", color=colour, markerfacecolor="white")
    figure.legend(loc="outside upper center", ncols=LEGEND_COLUMNS, frameon=False)
    figure.savefig(path, dpi=150)


def _quality(height: float, across: str) -> tuple[Figure, Axes]:
    """Axes for PSNR, upwards, and what `across` says; `height` in inches."""
    figure = Figure(figsize=(8, height), layout="constrained")
    axes = figure.subplots()
    axes.set_xlabel(across)
    axes.set_ylabel("PSNR, dB")
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    return figure, axes

"""Plots of measured rows, as PNG. They need no display and no global state."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator, ScalarFormatter
from numpy.typing import ArrayLike

from bench.results import COLD
from reports.comparison import written
from reports.parts import Mark, Plot
from reports.runs import Repeated, Run
from reports.tables import NOT_AVAILABLE

STAGE = "stage_ms."
LEGEND_COLUMNS = 4
LEGEND_WIDTH = 44
"""Characters per line in a legend of two columns."""
MARKERS = "osD^vP*X<>"
COLOURS = [matplotlib.colormaps["tab20"](index) for index in (*range(0, 20, 2), *range(1, 20, 2))]
COLOURS = [colour for colour in COLOURS if len(set(colour[:3])) > 1]  # grey is for "other"

MARK = "mark-{}"
"""The `gid` of the mark for the line with this number in `quality_against`."""

NAME_SIZE = (160, 13)
"""Width and height in pixels of the name of a setting on a plot."""

Row = Mapping[str, Any]


def stage_bars(runs: Sequence[Run], path: Path) -> None:
    """Write a PNG: one bar per run, its mean frame time in ms split into stages.

    A stage includes its nested stages and has the same colour in all bars. Time outside all stages
    is grey and comes last.
    """
    bars = [_stages(run) for run in runs]
    stages = list(dict.fromkeys(name for bar in bars for name in bar))
    stages.sort(key=lambda name: name == "other")
    legend_lines = -(-len(stages) // LEGEND_COLUMNS)
    figure = Figure(figsize=(8, 0.7 + 0.25 * legend_lines + 0.5 * len(runs)), layout="constrained")
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
    """Mean ms of every outermost stage, including its nested stages."""
    stages: dict[str, float] = {}
    for name, ms in run.values.items():
        if name.startswith(STAGE):
            outermost = name.removeprefix(STAGE).partition("/")[0]
            stages[outermost] = stages.get(outermost, 0.0) + ms
    return stages


def quality_plot(
    lines: Sequence[Repeated], metric: str, unit: float, axis: str, stem: str, shows: str
) -> Plot:
    """`quality_against` as a part of a page: each mark tells its label, PSNR and `metric`.

    A line that lacks one of these figures has no mark.
    """
    marks = {
        MARK.format(number): Mark(f"{line.label}: PSNR {quality} dB, {cost} {axis}", line.keys)
        for number, line in enumerate(lines)
        if (quality := written(line, "psnr") or NOT_AVAILABLE) != NOT_AVAILABLE
        and (cost := written(line, metric) or NOT_AVAILABLE) != NOT_AVAILABLE
    }
    draw = partial(quality_against, lines, metric, unit, axis)
    return Plot(stem, shows, draw, marks)


def quality_against(
    lines: Sequence[Repeated], metric: str, unit: float, axis: str, path: Path
) -> None:
    """Write a PNG: PSNR of each of `lines` against its `metric` / `unit`; `axis` is the label.

    With several seeds, error bars show the intervals of both.
    """
    labels = [textwrap.fill(line.label, LEGEND_WIDTH) for line in lines]
    half = -(-len(labels) // 2)  # the legend has two columns
    legend_lines = max("\n".join(part).count("\n") + 1 for part in (labels[:half], labels[half:]))
    figure, axes = _psnr_axes(4.0 + 0.25 * legend_lines, axis)
    for number, line in enumerate(lines):
        across, up = line.mean(metric), line.mean("psnr")
        if across is None or up is None:
            continue
        bars = [half if half > 0 else None for half in (line.half(metric), line.half("psnr"))]
        drawn = axes.errorbar(
            across / unit,
            up,
            xerr=bars[0] and bars[0] / unit,
            yerr=bars[1],
            fmt=MARKERS[number % len(MARKERS)],
            color=COLOURS[number % len(COLOURS)],
            markersize=8,
            label=labels[number],
        )
        drawn[0].set_gid(MARK.format(number))
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=_steps_of_a_decade(*axes.get_xlim())))
    axes.xaxis.set_major_formatter(ScalarFormatter())
    axes.xaxis.set_minor_locator(NullLocator())
    figure.legend(loc="outside lower center", ncols=2, frameon=False)
    figure.savefig(path, dpi=150)


def _steps_of_a_decade(low: float, high: float) -> tuple[int, ...]:
    """Which multiples of powers of ten get a tick: the wider the range, the fewer."""
    decades = math.log10(high / low)
    return (1, 2, 3, 5, 7) if decades < 1.5 else (1, 2, 5) if decades < 3 else (1,)


def quality_over_frames(runs: Sequence[Run], path: Path) -> None:
    """Write a PNG: PSNR of every frame with a ground truth along the path, one curve per run.

    Cold frames are hollow.
    """
    figure, axes = _psnr_axes(3.5, "frame of the path")
    for number, run in enumerate(runs):
        scored = run.frames.dropna(subset=["psnr"])
        colour, cold = COLOURS[number % len(COLOURS)], scored[scored["phase"] == COLD]
        axes.plot(scored["frame"], scored["psnr"], marker="o", color=colour, label=run.label)
        axes.plot(cold["frame"], cold["psnr"], "o", color=colour, markerfacecolor="white")
    figure.legend(loc="outside upper center", ncols=LEGEND_COLUMNS, frameon=False)
    figure.savefig(path, dpi=150)


@dataclass(frozen=True)
class Curve:
    """A model at several points of its training.

    Attributes:
        panel: the title of the panel that shows it.
        label: its name in the panel.
        points: training steps, each with what was measured after it.
    """

    panel: str
    label: str
    points: Mapping[float, Repeated]


def quality_over_training(curves: Sequence[Curve], path: Path) -> None:
    """Write a PNG: PSNR over training steps (log scale), one panel for each `panel` of `curves`.

    With several seeds, error bars show the intervals.
    """
    titles = list(dict.fromkeys(curve.panel for curve in curves))
    figure = Figure(figsize=(4.2 * len(titles), 3.6), layout="constrained")
    for axes, title in zip(figure.subplots(1, len(titles), squeeze=False)[0], titles, strict=True):
        _label_psnr(axes, "steps of stage 2")
        axes.set_title(title, fontsize="medium")
        shown = [curve for curve in curves if curve.panel == title]
        for number, curve in enumerate(shown):
            halves = [line.half("psnr") for line in curve.points.values()]
            axes.errorbar(
                list(curve.points),
                [line.mean("psnr") for line in curve.points.values()],
                yerr=np.nan_to_num(halves) if np.isfinite(halves).all() else None,
                marker=MARKERS[number % len(MARKERS)],
                color=COLOURS[number % len(COLOURS)],
                capsize=3,
                label=curve.label,
            )
        axes.set_xscale("log")
        steps = sorted({step for curve in shown for step in curve.points})
        axes.set_xticks(steps, [f"{step:g}" for step in steps])
        axes.xaxis.set_minor_locator(NullLocator())
        axes.legend(frameon=False, fontsize="small")
    figure.savefig(path, dpi=150)


def _psnr_axes(height: float, across: str) -> tuple[Figure, Axes]:
    """Axes with PSNR as y and the x label `across`; `height` in inches."""
    figure = Figure(figsize=(8, height), layout="constrained")
    axes = figure.subplots()
    _label_psnr(axes, across)
    return figure, axes


def _label_psnr(axes: Axes, across: str) -> None:
    axes.set_xlabel(across)
    axes.set_ylabel("PSNR, dB")
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)


def frontier_plot(rows: Sequence[Row], path: Path) -> None:
    """Write a PNG: error of a frame against its time, log-log, one point per setting.

    The left panel shows the error against the ground truth, with the Pareto frontier as a
    staircase; the right panel, the error against everything off. Settings on the frontier and the
    unchanged setting are circled, and named if there is room.

    Args:
        rows: everything off, the unchanged setting, then others. Each has knob, setting, ms, ms_lo,
            ms_hi, psnr, psnr_to_first and instead, which equals setting on the frontier.
    """
    figure = Figure(figsize=(13, 7), layout="constrained")
    truth, off = figure.subplots(1, 2, sharex=True)
    best = sorted((row for row in rows if row["instead"] == row["setting"]), key=lambda r: r["ms"])
    for axes, column in ((truth, "psnr"), (off, "psnr_to_first")):
        _error_against_time(axes, rows, column)
    fastest, slowest = truth.get_xlim()
    truth.set_xlim(fastest * (fastest / slowest) ** 0.2, slowest)  # room for names on the left
    stairs = [row["ms"] for row in best], [_rms(row["psnr"]) for row in best]
    truth.step(*stairs, where="post", color="black", linewidth=1, label="frontier")
    truth.set_title("against the ground truth: lower left is better")
    off.set_title("against the same model with everything off")
    figure.legend(*truth.get_legend_handles_labels(), loc="outside lower center", ncols=6)
    figure.draw_without_rendering()  # fixes the positions of points on the page
    _circle(truth, [*rows[1:2], *best], "psnr")
    _circle(off, rows[1:2], "psnr_to_first")
    figure.savefig(path, dpi=100)


def _circle(axes: Axes, rows: Sequence[Row], column: str) -> None:
    """Circle the points of `rows`, and name each on its left unless another name is there."""
    style: dict[str, Any] = {"textcoords": "offset points", "size": 8, "ha": "right", "va": "top"}
    names: list[np.ndarray] = []
    for row in rows:
        place = (row["ms"], _rms(row[column]))
        axes.plot(*place, "o", markersize=11, fillstyle="none", color="black")
        on_page = axes.transData.transform(place)
        if all((abs(on_page - other) > NAME_SIZE).any() for other in names):
            names.append(on_page)
            axes.annotate(row["setting"], place, xytext=(-5, -5), **style)


def _error_against_time(axes: Axes, rows: Sequence[Row], column: str) -> None:
    for number, knob in enumerate(dict.fromkeys(row["knob"] for row in rows)):
        some = [row for row in rows if row["knob"] == knob and math.isfinite(row[column])]
        low = [row["ms"] - row["ms_lo"] for row in some]
        high = [row["ms_hi"] - row["ms"] for row in some]
        axes.errorbar(
            [row["ms"] for row in some],
            [_rms(row[column]) for row in some],
            xerr=(low, high),
            fmt=MARKERS[number % len(MARKERS)],
            color=COLOURS[number % len(COLOURS)],
            alpha=0.8,
            elinewidth=0.6,
            label=knob,
        )
    axes.loglog()
    axes.margins(0.15, 0.12)
    errors = [float(_rms(row[column])) for row in rows if math.isfinite(row[column])]
    if errors and max(errors) < 1.01 * min(errors):  # autoscale needs a range to work with
        axes.set_autoscaley_on(False)
        axes.set_ylim(min(errors) / 2, max(errors) * 2)
    axes.set_xlabel("ms of a frame: median of the rounds, bars from the fastest to the slowest")
    axes.set_ylabel("error of a pixel (root mean square; 1 is black against white)")
    decibels = axes.secondary_yaxis("right", functions=(_psnr, _rms))
    decibels.set_ylabel("PSNR, dB")
    decibels.yaxis.set_major_locator(MaxNLocator(10))
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.yaxis.set_major_locator(LogLocator(subs=(1, 1.5, 2, 3, 5, 7)))
    for axis in (axes.xaxis, axes.yaxis, decibels.yaxis):
        axis.set_major_formatter("{x:g}")
        axis.set_minor_locator(NullLocator())
    axes.grid(color="0.92")
    axes.set_axisbelow(True)


def _rms(psnr: ArrayLike) -> np.ndarray:
    return 10 ** (-np.asarray(psnr) / 20)


def _psnr(rms: ArrayLike) -> np.ndarray:
    return -20 * np.log10(rms)

"""Plots of measured rows. Drawn without a display and without global state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.figure import Figure

from reports.runs import Run

STAGE = "stage_ms."
LEGEND_COLUMNS = 6
COLOURS = [matplotlib.colormaps["tab20"](index) for index in (*range(0, 20, 2), *range(1, 20, 2))]
COLOURS = [colour for colour in COLOURS if len(set(colour[:3])) > 1]  # grey is for "other"


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


def growth_panels(
    axes: Mapping[str, Sequence[Mapping[str, Any]]],
    figures: Mapping[str, str],
    exponents: Mapping[tuple[str, str], float],
    path: Path,
) -> None:
    """Write a PNG: a column of panels for each of `axes`, a line of them for each of `figures`.

    Both scales are logarithmic, so that a power is a straight line; only where an axis begins at 0
    its own is not.

    Args:
        axes: by name, rows with "value" and a value of every figure.
        figures: key in a row, and label with unit.
        exponents: by axis and figure, shown where they are finite.
    """
    size = (0.5 + 2.2 * len(axes), 0.5 + 2.0 * len(figures))
    figure = Figure(figsize=size, layout="constrained")
    panels = figure.subplots(len(figures), len(axes), squeeze=False, sharey="row")
    for line, (key, label) in zip(panels, figures.items(), strict=True):
        for panel, (axis, rows) in zip(line, axes.items(), strict=True):
            values = [row["value"] for row in rows]
            panel.plot(values, [row[key] for row in rows], "o-", color=COLOURS[0], markersize=4)
            panel.set_yscale("log")
            if min(values) > 0:
                panel.set_xscale("log", base=2 if axis != "pixels" else 10)
            if (exponent := exponents[axis, key]) == exponent:
                panel.set_title(f"~ {axis}^{exponent:.2f}", fontsize="small")
            panel.set_xlabel(axis)
            panel.grid(alpha=0.3, which="both")
            panel.spines[["top", "right"]].set_visible(False)
        line[0].set_ylabel(label)
    figure.savefig(path, dpi=150)


def _is_stage(metric: str) -> bool:
    return metric.startswith(STAGE)

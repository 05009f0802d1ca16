"""How figures grow with what is varied, as a plot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from reports.figures import COLOURS


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
        axes: by name, rows with "value", its "label" and a value of every figure.
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
                panel.set_xscale("log")
            panel.set_xticks(values, [row["label"] for row in rows], rotation=90, fontsize="small")
            panel.xaxis.set_minor_locator(NullLocator())
            if (exponent := exponents[axis, key]) == exponent:
                panel.set_title(f"~ {axis}^{exponent:.2f}", fontsize="medium")
            panel.grid(alpha=0.3, which="both")
            panel.spines[["top", "right"]].set_visible(False)
        line[0].set_ylabel(label)
    figure.savefig(path, dpi=150)

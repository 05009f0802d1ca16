"""Plots of measured rows. Drawn without a display and without global state."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure

from reports.tables import headline

STAGE = "stage_ms."


def stage_bars(rows: pd.DataFrame, path: Path) -> None:
    """Write a PNG: one bar per run, its mean frame time in ms divided into stages.

    The frames are those of the headline: steady ones, where a run has any.
    """
    rows = headline(rows)
    stages = rows[rows["metric"].str.startswith(STAGE)]
    runs = list(dict.fromkeys(stages["run"]))
    figure = Figure(figsize=(8, 0.9 + 0.5 * len(runs)), layout="constrained")
    axes = figure.subplots()
    left = pd.Series(0.0, index=runs)
    for metric, of_stage in stages.groupby("metric", sort=False):
        widths = of_stage.set_index("run")["value"].reindex(runs, fill_value=0.0)
        label = str(metric).removeprefix(STAGE)
        axes.barh(range(len(runs)), widths, left=left, height=0.6, label=label)
        left += widths
    names = stages.drop_duplicates("run").set_index("run")["method"]
    axes.set_yticks(range(len(runs)), [f"{names[run]} ({run[:8]})" for run in runs])
    axes.invert_yaxis()
    axes.set_xlabel("mean ms of a frame")
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside upper center", ncols=6, frameon=False)
    figure.savefig(path, dpi=150)

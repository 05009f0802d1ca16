"""Settings of one model by time and error, as a plot."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator
from numpy.typing import ArrayLike

from reports.figures import COLOURS, MARKERS

NAME_SIZE = (160, 13)
"""Room that the name of a setting takes on a plot, in pixels."""


def frontier_plot(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Write a PNG: error of a frame against its time, log-log, a point for each setting.

    To the left the error against the ground truth, with the Pareto frontier as a staircase through
    the settings that none beats, to the right that against everything off. What lies on the
    frontier is circled, and named where there is room; so is the setting in which nothing is
    changed.

    Args:
        rows: everything off, the setting in which nothing is changed, others. Of each its knob,
            setting, ms, ms_lo, ms_hi, psnr, psnr_to_first and instead: itself on the frontier.
    """
    figure = Figure(figsize=(13, 7), layout="constrained")
    truth, off = figure.subplots(1, 2, sharex=True)
    best = sorted((row for row in rows if row["instead"] == row["setting"]), key=lambda r: r["ms"])
    for axes, column in ((truth, "psnr"), (off, "psnr_to_first")):
        _error_against_time(axes, rows, column)
    fastest, slowest = truth.get_xlim()
    truth.set_xlim(fastest * (fastest / slowest) ** 0.2, slowest)  # names stand to the left
    stairs = [row["ms"] for row in best], [_rms(row["psnr"]) for row in best]
    truth.step(*stairs, where="post", color="black", linewidth=1, label="frontier")
    truth.set_title("against the ground truth: lower left is better")
    off.set_title("against the same model with everything off")
    figure.legend(*truth.get_legend_handles_labels(), loc="outside lower center", ncols=6)
    figure.draw_without_rendering()  # from now on it is known where a point lies on the page
    _circle(truth, [*rows[1:2], *best], "psnr")
    _circle(off, rows[1:2], "psnr_to_first")
    figure.savefig(path, dpi=100)


def _circle(axes: Axes, rows: Sequence[Mapping[str, Any]], column: str) -> None:
    """Circle the points of `rows`; name each to its left, unless another name is there already."""
    names: list[np.ndarray] = []
    for row in rows:
        place = (row["ms"], _rms(row[column]))
        axes.plot(*place, "o", markersize=11, fillstyle="none", color="black")
        on_page = axes.transData.transform(place)
        if all((abs(on_page - other) > NAME_SIZE).any() for other in names):
            names.append(on_page)
            axes.annotate(
                row["setting"],
                place,
                xytext=(-5, -5),
                textcoords="offset points",
                size=8,
                ha="right",
                va="top",
            )


def _error_against_time(axes: Axes, rows: Sequence[Mapping[str, Any]], column: str) -> None:
    """The points of one panel; a knob has one colour and one marker."""
    knobs = list(dict.fromkeys(row["knob"] for row in rows))
    for number, knob in enumerate(knobs):
        some = [row for row in rows if row["knob"] == knob and math.isfinite(row[column])]
        ms, error = [row["ms"] for row in some], [_rms(row[column]) for row in some]
        low = [row["ms"] - row["ms_lo"] for row in some]
        high = [row["ms_hi"] - row["ms"] for row in some]
        colour, marker = COLOURS[number % len(COLOURS)], MARKERS[number % len(MARKERS)]
        axes.errorbar(
            ms,
            error,
            xerr=(low, high),
            fmt=marker,
            color=colour,
            alpha=0.8,
            elinewidth=0.6,
            label=knob,
        )
    axes.loglog()
    axes.margins(0.15, 0.12)
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

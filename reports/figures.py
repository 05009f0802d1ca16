"""Plots of measured rows, as PNG. They need no display and no global state."""

import math
import warnings
from collections.abc import Mapping, Sequence
from functools import partial
from itertools import cycle
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator, ScalarFormatter
from matplotlib.transforms import Bbox
from numpy.typing import ArrayLike

from bench.clock import OTHER
from bench.results import COLD
from reports.comparison import written
from reports.images import Picture
from reports.lines import METHOD, Lines, Settings
from reports.runs import Repeated, Run, Runs, TableLines
from reports.tables import NOT_AVAILABLE

LEGEND_COLUMNS = 4
MOST_NAMES = 10  # on a plot; more lines have a legend
MARKERS = "osD^vP*X<>"
COLOURS = [matplotlib.colormaps["tab20"](index) for index in (*range(0, 20, 2), *range(1, 20, 2))]
COLOURS = [colour for colour in COLOURS if len(set(colour[:3])) > 1]  # grey is for "other"

COSTS = {
    "frame_ms": ("psnr-ms", 1.0, "ms a frame"),
    "size_bytes.total": ("psnr-bytes", 1e6, "MB of the model"),
}
"""What quality is plotted against: prefix of the file name, unit and label of the axis."""

PLACES = ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, 1), (1, -1), (-1, -1))
"""Where the name of a point may be, across and up: right of it at best."""

MARK = "mark-{}"  # the `gid` of the mark of the line with this number

TICKS = {
    0.7: (1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6, 7, 8, 9),
    1.5: (1, 2, 3, 5, 7),
    3: (1, 2, 5),
    math.inf: (1,),
}
"""Ticks in each decade of a logarithmic axis with fewer decades than that."""

NAME_SIZE = (160, 13)  # width and height in pixels of the name of a setting on a plot


def stage_bars(runs: Sequence[Run | Repeated], path: Path) -> None:
    """Write a PNG: one bar per run or line, its mean frame time in ms split into parts; time
    outside all stages is grey and comes last."""
    widths = pd.DataFrame([run.parts for run in runs]).fillna(0.0)
    widths[OTHER] = widths.pop(OTHER)
    ends = widths.cumsum(axis=1)
    legend_lines = -(-len(widths.columns) // LEGEND_COLUMNS)
    figure, axes = _plot(height=0.7 + 0.25 * legend_lines + 0.5 * len(runs))
    for number, (part, width) in enumerate(widths.items()):
        colour = "lightgrey" if part == OTHER else _style(number)["color"]
        axes.barh(
            widths.index, width, left=ends[part] - width, height=0.6, label=part, color=colour
        )
    for line, end in enumerate(ends[OTHER]):
        axes.text(end, line, f" {end:.1f}", va="center")
    axes.set_xlim(0, 1.12 * max(ends[OTHER]))
    axes.set_yticks(widths.index, [run.label for run in runs])
    axes.invert_yaxis()
    axes.set_xlabel("mean ms of a frame")
    _save_with_legend(figure, path)


def quality_plot(
    lines: TableLines, metric: str, settings: Mapping[str, Sequence[str]] = {}
) -> Picture:
    """`quality_against` as a part of a page, with a mark for each line that has both figures."""
    stem, _, axis = COSTS[metric]
    marks = {}
    for number, line in enumerate(lines):
        quality, cost = written(line, "psnr"), written(line, metric)
        if not {quality, cost} & {None, NOT_AVAILABLE}:
            says = f"{line.label}: PSNR {quality} dB, {cost} {axis}"
            marks[MARK.format(number)] = says, line.keys
    shows = f"PSNR in dB against {axis}, one mark a line"
    return Picture(stem, shows, partial(quality_against, lines, metric, settings=settings), marks)


def quality_against(
    lines: TableLines, metric: str, path: Path, settings: Mapping[str, Sequence[str]] = {}
) -> None:
    """Write a PNG: PSNR of each of `lines` against its `metric`, one of `COSTS`, with its name.

    With several seeds, error bars show the intervals of both. More than a few lines have a legend
    instead of names, and so has an ablation of one method. It is made of their `settings`: a
    colour for each value of the first that differs, a marker for the others.
    """
    _, unit, label = COSTS[metric]
    figure, axes = _of_quality(label)
    first = next(iter(settings.values()), range(len(lines)))  # methods
    styles: Sequence[Mapping[str, Any]] = [_style(number) for number in range(len(lines))]
    handles: Sequence[Line2D] = ()
    crowded = len(set(first)) < len(lines) or len(lines) > MOST_NAMES
    if crowded and any(len(set(of)) > 1 for of in settings.values()):
        styles, handles = _legend(settings)
    points = []
    for number, line in enumerate(lines):
        across, up = line.mean(metric), line.mean("psnr")
        if across is None or up is None:
            continue
        bars = [half if half > 0 else None for half in (line.half(metric), line.half("psnr"))]
        # On a logarithmic axis, an interval over two seeds may reach below any time.
        reach = bars[0] and [[min(bars[0], across / 2) / unit], [min(bars[0], across) / unit]]
        style = {**styles[number], "xerr": reach, "yerr": bars[1]}
        drawn = axes.errorbar(across / unit, up, **style, markersize=8, elinewidth=0.8)
        drawn[0].set_gid(MARK.format(number))
        points.append((line.label, (across / unit, up)))
    axes.set_xscale("log")
    axes.margins(0.1)
    low, high = axes.get_xlim()
    decades = math.log10(high / low)  # the more of them, the fewer ticks in each
    ticks = next(ticks for most, ticks in TICKS.items() if decades < most)
    axes.xaxis.set_major_locator(LogLocator(subs=ticks))
    axes.xaxis.set_major_formatter(ScalarFormatter())
    axes.xaxis.set_minor_locator(NullLocator())
    if handles:
        columns = -(-len(handles) // 20)
        figure.legend(handles=handles, loc="outside right upper", ncols=columns, frameon=False)
    else:
        _name(axes, points)
    _save(figure, path)


def _legend(
    settings: Settings,
) -> tuple[Sequence[Mapping[str, Any]], Sequence[Line2D]]:
    """The style of each line by its settings, and what a legend says of them: the first setting
    that differs has colours, the others markers."""
    first, *rest = (
        [f"{name}={value}" for value in of] for name, of in settings.items() if len(set(of)) > 1
    )
    others = list(map(", ".join, zip(*rest, strict=True))) if rest else [""] * len(first)
    colours = dict(zip(dict.fromkeys(first), cycle(COLOURS), strict=False))
    markers = dict(zip(dict.fromkeys(others), cycle(MARKERS), strict=False))
    of_lines = zip(first, others, strict=True)
    styles = [{"color": colours[x], "marker": markers[y], "linestyle": "none"} for x, y in of_lines]
    shown = [(name, colour, "o") for name, colour in colours.items()]
    shown += [(name, "grey", marker) for name, marker in markers.items() if name]
    return styles, [
        Line2D([], [], linestyle="none", label=name, color=colour, marker=marker)
        for name, colour, marker in shown
    ]


def _name(axes: Axes, points: Sequence[tuple[str, tuple[float, float]]]) -> None:
    """Write each name beside its point, where it covers no other name and no point."""
    axes.get_figure().draw_without_rendering()  # type: ignore[union-attr]
    on_page = [axes.transData.transform(point) for _, point in points]
    taken = [Bbox.from_extents(*(place - 6), *(place + 6)) for place in on_page]
    for name, point in points:
        text = axes.annotate(name, point, (0, 0), textcoords="offset points", size=9)
        text.set_in_layout(False)
        for across, up in PLACES:
            text.xyann = (8 * across, 8 * up)
            text.set(
                ha=("right", "center", "left")[across + 1], va=("top", "center", "bottom")[up + 1]
            )
            box = text.get_window_extent()
            inside = axes.bbox.x0 < box.x0 and box.x1 < axes.bbox.x1
            if inside and not box.count_overlaps(taken):
                break
        taken.append(box)


def quality_over_frames(runs: Runs, path: Path) -> None:
    """Write a PNG: PSNR of scored frames along the path, one curve per run; cold are hollow."""
    figure, axes = _of_quality("frame of the path", height=3.5)
    for number, run in enumerate(runs):
        scored = run.frames.dropna(subset=["psnr"])
        colour, cold = _style(number)["color"], scored[scored["phase"] == COLD]
        axes.plot(scored["frame"], scored["psnr"], marker="o", color=colour, label=run.label)
        axes.plot(cold["frame"], cold["psnr"], "o", color=colour, markerfacecolor="white")
    _save_with_legend(figure, path)


def quality_along(lines: Lines, name: str, path: Path) -> None:
    """Write a PNG: PSNR over the numbers that the setting `name` has, a curve for each choice of
    the others, with intervals over seeds. Lines that lack the setting are dashed, all across."""
    table = lines.frame(["psnr"])
    others = [x for x in lines.settings if x != name and table[x].nunique() > 1]
    words = [
        ", ".join(f"{x}={row[x]}".removeprefix(f"{METHOD}=") for x in others)
        for row in table.to_dict("records")
    ]
    across, scored = table[name].map(as_number), table["psnr"].notna()
    figure, axes = _of_quality(name)
    for number in table.index[scored & across.isna()]:
        style = {**_style(number), "linestyle": "--", "label": lines.lines[number].label}
        axes.axhline(table["psnr"][number], **style)
    points = table[scored & across.notna()].groupby(pd.Series(words), sort=False)
    for number, (label, of_curve) in enumerate(points):
        curve = of_curve.set_index(across[of_curve.index]).sort_index()
        means, bars = curve["psnr"].replace(math.inf, math.nan), curve["psnr.half"].fillna(0)
        style = {**_style(number), "capsize": 3, "label": label, "linestyle": "-"}
        axes.errorbar(curve.index, means, yerr=bars if bars.any() else None, **style)
    ticks = sorted(across[scored].dropna().unique())
    if ticks[0] > 0 and ticks[-1] > 10 * ticks[0]:
        axes.set_xscale("log")
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.xaxis.set_minor_locator(NullLocator())
    if len(axes.get_legend_handles_labels()[1]) > 1:
        axes.legend(frameon=False)
    _save(figure, path)


def as_number(value: str) -> float | None:
    """What a setting says, if that is a number; of a power of 2, the exponent."""
    try:
        number = float(value.removeprefix("2^"))
        return number if math.isfinite(number) else None
    except ValueError:
        return None


def _style(number: int) -> dict[str, Any]:
    marker, colour = MARKERS[number % len(MARKERS)], COLOURS[number % len(COLOURS)]
    return {"marker": marker, "color": colour, "linestyle": "none"}


def _of_quality(across: str, height: float = 4.5) -> tuple[Figure, Axes]:
    """An empty plot of the PSNR, with the label of the axis across."""
    figure, axes = _plot(height)
    axes.set_xlabel(across)
    axes.set_ylabel("PSNR, dB")
    axes.grid(alpha=0.3)
    return figure, axes


def _plot(height: float) -> tuple[Figure, Axes]:
    """An empty plot, open at the top and on the right."""
    figure = Figure(figsize=(8, height), layout="constrained")
    axes = figure.subplots()
    axes.spines[["top", "right"]].set_visible(False)
    return figure, axes


def frontier_plot(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Write a PNG: error of a frame against its time, log-log, one point per setting.

    The left panel shows the error against the ground truth, with the Pareto frontier as a
    staircase; the right panel, the error against the first of `rows`. Settings on the frontier
    (`frontier`) and the `unchanged` one are circled, and named if there is
    room. What takes more than twice as long as any of the frontier is only named.
    """
    figure = Figure(figsize=(11, 6.5), layout="constrained")
    truth, off = figure.subplots(1, 2, sharex=True)
    every = pd.DataFrame(rows)
    best = every[every["frontier"]].sort_values("ms", kind="stable")
    far = every["ms"] > 2 * best["ms"].max()
    table = every[~far]
    unchanged = table[table["unchanged"]]
    left_out = (f"{row.setting}, {row.ms:,.0f} ms" for row in every[far].itertuples())
    if text := "; ".join(left_out):
        figure.suptitle(f"not shown: {text}", size="small")
    _error_against_time(truth, table, "psnr")
    _error_against_time(off, table, "psnr_to_first")
    fastest, slowest = truth.get_xlim()
    truth.set_xlim(fastest * (fastest / slowest) ** 0.2, slowest)  # room for names on the left
    truth.step(
        best["ms"], _rms(best["psnr"]), where="post", color="black", linewidth=1, label="frontier"
    )
    truth.set_title("against the ground truth: lower left is better")
    off.set_title(f"against the same model, {rows[0]['setting']}")
    figure.legend(*truth.get_legend_handles_labels(), loc="outside lower center", ncols=6)
    figure.draw_without_rendering()  # fixes the positions of points on the page
    _circle(truth, pd.concat([unchanged, best]), "psnr")
    _circle(off, unchanged[np.isfinite(unchanged["psnr_to_first"])], "psnr_to_first")
    _save(figure, path, 100)


def _circle(axes: Axes, rows: pd.DataFrame, column: str) -> None:
    """Circle the points of `rows`, and name each on its left unless another name is there."""
    style: dict[str, Any] = {"textcoords": "offset points", "size": 8, "ha": "right", "va": "top"}
    names: list[np.ndarray] = []
    for setting, ms, error in zip(rows["setting"], rows["ms"], _rms(rows[column]), strict=True):
        place = (ms, error)
        axes.plot(*place, "o", markersize=11, fillstyle="none", color="black")
        on_page = axes.transData.transform(place)
        if all((abs(on_page - other) > NAME_SIZE).any() for other in names):
            names.append(on_page)
            axes.annotate(setting, place, xytext=(-5, -5), **style)


def _error_against_time(axes: Axes, rows: pd.DataFrame, column: str) -> None:
    finite = rows[np.isfinite(rows[column])]
    for number, knob in enumerate(rows["knob"].unique()):
        some = finite[finite["knob"] == knob]
        bars = some["ms"] - some["ms_lo"], some["ms_hi"] - some["ms"]
        style = {**_style(number), "alpha": 0.8, "elinewidth": 0.6, "label": knob}
        axes.errorbar(some["ms"], _rms(some[column]), xerr=bars, **style)
    axes.loglog()
    axes.margins(0.15, 0.12)
    errors = _rms(finite[column])
    if len(errors) and errors.max() < 1.01 * errors.min():  # autoscale needs a range to work with
        axes.set_autoscaley_on(False)
        axes.set_ylim(errors.min() / 2, errors.max() * 2)
    axes.set_xlabel("ms a frame: median, fastest and slowest round")
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


def _save_with_legend(figure: Figure, path: Path) -> None:
    figure.legend(loc="outside upper center", ncols=LEGEND_COLUMNS, frameon=False)
    _save(figure, path)


def _save(figure: Figure, path: Path, dpi: int = 150) -> None:
    with warnings.catch_warnings():  # a letter that the font lacks is a box; pages have it in text
        warnings.filterwarnings("ignore", "Glyph")
        figure.savefig(path, dpi=dpi)


def _rms(psnr: ArrayLike) -> np.ndarray:
    return 10 ** (-np.asarray(psnr) / 20)


def _psnr(rms: ArrayLike) -> np.ndarray:
    return -20 * np.log10(rms)

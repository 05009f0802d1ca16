"""Time against error: tables and a page, for kernels and for whole methods."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any

import pandas as pd

from bench.errors import explained
from bench.provenance import commit, machine
from bench.sharing import whole
from reports.figures import frontier_plot
from reports.images import Part, Picture
from reports.publish import publish
from reports.tables import Table, decimal, spread

Row = Mapping[str, Any]

EXPERIMENTS = ("computed", "knob", "setting", "largest error ↓", "ms ↓", "observed order")
SETTINGS = (
    *("setting", "ms / frame ↓", "spread", "PSNR, dB ↑", "lost, dB ↓"),
    *("PSNR to everything off, dB ↑", "better at no more time"),
)

ON_FRONTIER = "— (frontier)"


def experiment_table(rows: Sequence[Row]) -> Table:
    """One line per experiment: its first and last setting, and the observed order."""
    lines = []
    for subject, some in groupby(rows, lambda row: row["subject"]):
        first, *others = some
        ends = [first, *others[-1:]]
        order = ""
        if first["order"] is not None:
            span = f"{_setting(first['order_from'])} to {_setting(first['order_to'])}"
            order = f"{first['order']:.2f} ({span})"
        figures = zip(*map(_trial, ends), strict=True)
        lines.append((subject, first["knob"], *map(" to ".join, figures), order))
    title = "Kernels: run time against error, where the exact answer is known"
    return Table(title, EXPERIMENTS, tuple(lines))


def _trial(row: Row) -> tuple[str, str, str]:
    return _setting(row["setting"]), f"{row['error']:.1e}", decimal(row["ms"], 2)


def setting_table(rows: Sequence[Row]) -> Table:
    """A table of all settings, fastest first; those on the Pareto frontier are bold."""
    lines = tuple(
        (
            row["setting"],
            decimal(row["ms"], 1),
            spread(row["ms_lo"], row["ms_hi"]),
            decimal(row["psnr"], 2),
            decimal(row["lost"], 2),
            decimal(row["psnr_to_first"], 1) if math.isfinite(row["psnr_to_first"]) else "the same",
            ON_FRONTIER if row["instead"] == row["setting"] else row["instead"],
        )
        for row in sorted(rows, key=lambda row: row["ms"])
    )
    bold = frozenset((line, 0) for line, text in enumerate(lines) if text[-1] == ON_FRONTIER)
    where = ", ".join(str(rows[0][name]) for name in ("scene", "trajectory", "resolution"))
    title = f"Settings: run time against error of a frame, {where}"
    return Table(title, SETTINGS, lines, bold=bold)


def write_tradeoff(
    experiments: Sequence[Row], settings: Sequence[Row], folder: Path, command: str
) -> Path:
    """Write `folder/report.md` and `report.html`, with the plot and all rows as CSV beside them.

    `experiments` are rows of kernels; `settings` are rows of methods, and may be missing. Returns
    the path of report.md; raises SteerbenchError if `folder` cannot be written to.
    """
    tables = [experiment_table(experiments)]
    made = f"```sh\n{command}\n```\n\nCommit {commit()}, {machine()['cpu']}."
    parts: list[Part] = ["# Run time against error", made]
    if settings:
        shows = "Error of a frame against its time, one point a setting"
        parts.append(Picture("frontier", shows, partial(frontier_plot, settings)))
        tables.insert(0, setting_table(settings))
    parts += [part for table in tables for part in (f"## {table.title}", table)]
    with explained(folder):
        folder.mkdir(parents=True, exist_ok=True)
        for name, rows in (("kernels", experiments), ("settings", settings)):
            if rows:
                with whole(folder / f"{name}.csv") as new:
                    pd.DataFrame(rows).to_csv(new, index=False)
    return publish(parts, folder)


def _setting(value: float | str) -> str:
    """A short number, with powers of two below 1 as fractions; text is unchanged."""
    if isinstance(value, str):
        return value
    if 0 < value < 1 and math.frexp(value)[0] == 0.5:
        return f"1/{1 / value:.0f}"
    return f"{value:g}"

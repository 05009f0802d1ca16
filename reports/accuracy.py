"""Run time against error, as tables and a page; see `bench.accuracy` for the rows."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from bench.errors import explained
from bench.provenance import commit, machine
from bench.sharing import whole
from reports.frontier import frontier_plot
from reports.publish import publish
from reports.tables import Table, number

Row = Mapping[str, Any]

EXPERIMENTS = ("computed", "knob", "setting", "largest error ↓", "ms ↓", "observed order")
SETTINGS = (
    "setting",
    "ms / frame ↓",
    "spread",
    "PSNR, dB ↑",
    "lost, dB ↓",
    "PSNR to everything off, dB ↑",
    "better at no more time",
)

ON_FRONTIER = "— (frontier)"


def experiment_table(rows: Sequence[Row]) -> Table:
    """Every setting of every experiment; its order stands in the first line of an experiment."""
    lines = []
    subject = None
    for row in rows:
        begins = row["subject"] != subject
        subject = row["subject"]
        lines.append(
            (
                subject if begins else "",
                row["knob"] if begins else "",
                _setting(row["setting"]),
                f"{row['error']:.1e}",
                number(row["ms"], 2),
                _order(row) if begins else "",
            )
        )
    title = "Kernels: run time against error, where the exact answer is known"
    return Table(title, EXPERIMENTS, tuple(lines))


def setting_table(rows: Sequence[Row]) -> Table:
    """Every setting, the fastest first; what lies on the frontier is bold."""
    ordered = sorted(rows, key=lambda row: row["ms"])
    lines = tuple(
        (
            row["setting"],
            number(row["ms"], 1),
            f"{number(row['ms_lo'], 1)} – {number(row['ms_hi'], 1)}",
            number(row["psnr"], 2),
            number(row["lost"], 2),
            number(row["psnr_to_first"], 1) if math.isfinite(row["psnr_to_first"]) else "the same",
            ON_FRONTIER if row["instead"] == row["setting"] else row["instead"],
        )
        for row in ordered
    )
    bold = frozenset((line, 0) for line, text in enumerate(lines) if text[-1] == ON_FRONTIER)
    where = ", ".join(str(rows[0][name]) for name in ("scene", "trajectory", "resolution"))
    return Table(
        f"Settings: run time against error of a frame, {where}", SETTINGS, lines, bold=bold
    )


def write_accuracy(
    experiments: Sequence[Row], settings: Sequence[Row], folder: Path, command: str
) -> Path:
    """Write `folder/report.md` and `report.html`, the plot and all rows as CSV beside them; return
    the path of the first.

    `command` is what was typed.

    Raises:
        SteerbenchError: `folder` cannot be written to.
    """
    tables = [experiment_table(experiments)]
    with explained(folder):
        folder.mkdir(parents=True, exist_ok=True)
        with whole(folder / "kernels.csv") as new:
            pd.DataFrame(experiments).to_csv(new, index=False)
        made = f"```sh\n{command}\n```\n\nCommit {commit()}, {machine()['cpu']}."
        parts = ["# Run time against error", made]
        if settings:
            with whole(folder / "settings.csv") as new:
                pd.DataFrame(settings).to_csv(new, index=False)
            with whole(folder / "frontier.png") as new:
                frontier_plot(settings, new)
            parts.append("![Error of a frame against its time, one point a setting](frontier.png)")
            tables.insert(0, setting_table(settings))
        parts += [f"## {table.title}\n\n{table.markdown()}" for table in tables]
    return publish("\n\n".join(parts), folder)


def _setting(value: float | str) -> str:
    """In few digits; a power of two below 1 as a fraction."""
    if isinstance(value, str):
        return value
    if 0 < value < 1 and math.frexp(value)[0] == 0.5:
        return f"1/{1 / value:.0f}"
    return f"{value:g}"


def _order(row: Row) -> str:
    if row["order"] is None:
        return ""
    return f"{row['order']:.2f} ({_setting(row['order_from'])} to {_setting(row['order_to'])})"

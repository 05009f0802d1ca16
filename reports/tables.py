"""The rows of a run as tables of text: for the terminal, for a page.

Units are those of the field: dB, milliseconds, MB = 10^6 bytes. Every LPIPS column names its
network. A figure that could not be had reads `n/a`.

The headline figures of a run are those of its steady frames. Where a method also rendered frames
with less to look back on than it can use, these stand apart and are called cold.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import pandas as pd

from bench.results import COLD, STEADY

NOT_AVAILABLE = "n/a"

DENSE = ".dense"
"""How the name of a counter ends that says what skipping nothing would have taken."""

QUALITY = {
    "psnr": ("PSNR, dB ↑", 2),
    "ssim": ("SSIM ↑", 4),
    "lpips_alex": ("LPIPS alex ↓", 4),
    "lpips_vgg": ("LPIPS vgg ↓", 4),
    "lpips_squeeze": ("LPIPS squeeze ↓", 4),
    "flicker": ("flicker ↓", 4),
}
"""Label and decimals of each metric of a picture; the arrow points to better."""


@dataclass(frozen=True)
class Table:
    """`lines` of text under `columns`.

    The first column is a label; the others are figures, or text when `figures` is False. `bold`
    holds the line and the column, from 0, of every cell that stands out.
    """

    title: str
    columns: tuple[str, ...]
    lines: tuple[tuple[str, ...], ...]
    figures: bool = True
    bold: frozenset[tuple[int, int]] = frozenset()

    def markdown(self) -> str:
        """The table in GitHub's Markdown, without its title."""
        rule = ("---", *("---:" if self.figures else "---" for _ in self.columns[1:]))
        lines = [
            [self._cell(text, (row, column)) for column, text in enumerate(line)]
            for row, line in enumerate(self.lines)
        ]
        return "\n".join(f"| {' | '.join(line)} |" for line in (self.columns, rule, *lines))

    def _cell(self, text: str, place: tuple[int, int]) -> str:
        escaped = text.replace("|", "\\|")
        return f"**{escaped}**" if place in self.bold else escaped


def headline(rows: pd.DataFrame) -> pd.DataFrame:
    """Of every run the rows of its first phase, steady where it has one, and of the whole run."""
    steady = set(rows.loc[rows["phase"] == STEADY, "run"])
    return rows[(rows["phase"] != COLD) | ~rows["run"].isin(steady)]


def blocks(rows: pd.DataFrame) -> list[Table]:
    """The tables of one run: quality, time by stage and, where it counted any, work of each phase;
    memory."""
    tables = [
        table(of_phase, suffix(phase))
        for phase, of_phase in phases(rows)
        for table in (_quality, _time, _work)
    ]
    return [*(table for table in tables if table.lines), _memory(rows)]


def phases(rows: pd.DataFrame) -> list[tuple[str, pd.DataFrame]]:
    """The rows of one run by phase, steady ones first, without those of the whole run."""
    by_phase = [(phase, rows[rows["phase"] == phase]) for phase in (STEADY, COLD)]
    return [(phase, of_phase) for phase, of_phase in by_phase if len(of_phase)]


def suffix(phase: str) -> str:
    """What a label says of its frames: nothing when they are steady."""
    return "" if phase == STEADY else f", {phase}"


def _values(rows: pd.DataFrame, prefix: str = "", column: str = "value") -> dict[str, float]:
    """Figures of one run by metric, for metrics that begin with `prefix`, which is cut off."""
    return {
        metric.removeprefix(prefix): figure
        for metric, figure in zip(rows["metric"], rows[column], strict=True)
        if metric.startswith(prefix)
    }


def _quality(rows: pd.DataFrame, suffix: str) -> Table:
    value, low, high, frames = (_values(rows, column=name) for name in ("value", "lo", "hi", "n"))
    lines = []
    for metric, (label, decimals) in QUALITY.items():
        if metric in value:
            known = math.isfinite(low[metric])
            ends = (number(end[metric], decimals) for end in (low, high))
            lines.append(
                (label, number(value[metric], decimals), " – ".join(ends) if known else "")
            )
    title = f"Quality{suffix}, mean of {frames['psnr']} frames"
    return Table(title, ("metric", "mean", "95 % interval"), tuple(lines))


def _time(rows: pd.DataFrame, suffix: str) -> Table:
    value, stages = _values(rows), _values(rows, "stage_ms.")
    total = value["frame_ms"]
    lines = [(name, number(ms, 2), share(ms, total)) for name, ms in stages.items()]
    lines.append(("frame", number(total, 2), share(sum(stages.values()), total)))
    lines += [
        (f"frame, {quantile}", number(value[f"frame_ms.{quantile}"], 2), "")
        for quantile in ("p50", "p95", "p99")
    ]
    if "latency_ms" in value:
        lines.append(("latency", number(value["latency_ms"], 2), ""))
    lines.append(("FPS", number(value["fps"], 2), ""))
    return Table(f"Time of a frame{suffix}", ("stage", "mean ms", "share"), tuple(lines))


def _work(rows: pd.DataFrame, suffix: str) -> Table:
    """The ledger: what was done, beside what a method that skips nothing would have done."""
    value = _values(rows, "work.")
    lines = []
    for name in value:
        done, dense = value[name], value.get(f"{name}{DENSE}")
        if not name.endswith(DENSE):
            saved = "" if dense is None else share(dense - done, dense)
            figures = ("" if x is None else number(x, 0 if x >= 100 else 1) for x in (done, dense))
            lines.append((name.replace("_", " "), *figures, saved))
    return Table(f"Work of a frame{suffix}", ("work", "done", "dense", "saved"), tuple(lines))


def _memory(rows: pd.DataFrame) -> Table:
    value, sizes = _values(rows), _values(rows, "size_bytes.")
    total = sizes.pop("total")
    lines = [(name, megabytes(size)) for name, size in sizes.items()]
    lines.append(("model", megabytes(total)))
    lines.append(("peak, rendering", megabytes(value["peak_bytes"])))
    return Table("Memory", ("component", "MB"), tuple(lines))


def number(value: float | None, decimals: int) -> str:
    """A figure with `decimals`, or `n/a` where there is none; what rounds to 0 has no sign."""
    if value is None or math.isnan(value):
        return NOT_AVAILABLE
    return f"{round(value, decimals) + 0.0:,.{decimals}f}"


def megabytes(size: float | None) -> str:
    """Bytes as MB = 10^6 bytes."""
    return number(None if size is None else size / 1e6, 2)


def share(part: float, whole: float) -> str:
    """`part` as a percentage of `whole`."""
    return f"{number(100 * part / whole, 1)} %" if whole else NOT_AVAILABLE

"""Tables of text for the terminal and for pages, and the format of figures in them.

Units are dB, milliseconds and MB = 10^6 bytes. Every LPIPS column names its network. Cold frames,
which have fewer preceding frames than the method can use, are listed separately.
"""

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import pandas as pd

from bench.results import COLD, STEADY

NOT_AVAILABLE = "n/a"
ABSENT = "–"  # of a figure that the paper does not give or that cannot be measured here
EMPTY = ("", ABSENT, NOT_AVAILABLE)
DENSE = ".dense"  # suffix of a work counter for the work of a method that skips nothing
NETS = ("alex", "vgg")  # of LPIPS


Write = Callable[[float], str]


@dataclass(frozen=True)
class Metric:
    """How a metric is shown: its `name` with the unit, an arrow to `better` values, "" if neither
    is, and how its figures are written."""

    name: str
    better: str
    write: Write

    @property
    def heading(self) -> str:
        return f"{self.name} {self.better}".rstrip()


Rows = Sequence[Sequence[str]]  # cells, line by line


@dataclass(frozen=True)
class Table:
    """Lines under columns, in Markdown: a label, then figures or text. `sources` has the keys of
    the runs behind each line, or is empty."""

    title: str
    columns: Sequence[str]
    lines: Rows
    sources: Rows = ()

    def right(self, column: int) -> bool:
        """Whether the column is aligned right: at least half of what is in it are figures."""
        cells = [line[column] for line in self.lines if line[column] not in EMPTY]
        figures = sum(re.match(r"[-+±×*]*\d", cell) is not None for cell in cells)
        return column > 0 and 2 * figures >= len(cells)

    def section(self) -> str:
        """The table in GitHub's Markdown below its title, and an end of line."""
        return f"## {self.title}\n\n{self.markdown()}\n"

    def markdown(self) -> str:
        """The table in GitHub's Markdown, without its title."""
        rules = ("---:" if self.right(column) else "---" for column in range(len(self.columns)))
        cells = ((text.replace("|", "\\|") for text in line) for line in self.lines)
        head, *lines = (f"| {' | '.join(row)} |" for row in (self.columns, *cells))
        return "\n".join((head, f"|{'|'.join(rules)}|", *lines))


BOLD = ("**%s**", "*%s*")
"""What the best and, where that is shown, the second-best figure of a column look like."""


def decimal(value: float | None, decimals: int) -> str:
    """`value` with this number of `decimals`, or `n/a`. A value that rounds to 0 gets no sign."""
    if value is None or math.isnan(value):
        return NOT_AVAILABLE
    return f"{round(value, decimals) + 0.0:,.{decimals}f}"


def amount(value: float) -> str:
    """A count: 12,345 or 1.23 M."""
    for size, letter in ((1e9, "G"), (1e6, "M")):
        if value >= size:
            return f"{decimal(value / size, 2)} {letter}"
    return decimal(value, 0)


QUALITY = {
    metric: Metric(name, better, partial(decimal, decimals=decimals))
    for metric, (name, better, decimals) in {
        "psnr": ("PSNR, dB", "↑", 2),
        "ssim": ("SSIM", "↑", 4),
        **{f"lpips_{net}": (f"LPIPS {net}", "↓", 4) for net in NETS},
        "cc_psnr": ("PSNR of corrected colours, dB", "↑", 2),
        "cc_ssim": ("SSIM of corrected colours", "↑", 4),
        **{f"cc_lpips_{net}": (f"LPIPS {net} of corrected colours", "↓", 4) for net in NETS},
        "flicker": ("flicker", "↓", 4),
        "tpsnr": ("tPSNR, dB", "↑", 2),
        **{f"tlpips_{net}": (f"tLPIPS {net}", "↓", 4) for net in NETS},
        **{f"warp_{k}": (f"warping error, {k} apart", "↓", 5) for k in (1, 7)},
        **{f"warp_{k}_true": (f"warping error of the truth, {k} apart", "", 5) for k in (1, 7)},
        **{f"warp_{k}_own": (f"warping error, {k} apart, own depth", "↓", 5) for k in (1, 7)},
    }.items()
}


def megabytes(size: float | None) -> str:
    """Bytes as MB = 10^6 bytes."""
    return decimal(None if size is None else size / 1e6, 2)


def share(part: float, whole: float) -> str:
    return f"{decimal(100 * part / whole, 1)} %" if whole else NOT_AVAILABLE


def phases(rows: pd.DataFrame) -> list[tuple[str, pd.DataFrame]]:
    """The rows of one run by phase, steady first, without rows about the whole run.

    Each has the suffix of labels for its figures; that of steady frames is empty.
    """
    by_phase = {"": rows[rows["phase"] == STEADY], ", cold": rows[rows["phase"] == COLD]}
    return [(suffix, of_phase) for suffix, of_phase in by_phase.items() if len(of_phase)]


def run_tables(rows: pd.DataFrame) -> list[Table]:
    """The tables of one run: quality, time by stage and work for each phase; memory.

    For pictures that were only scored, there is only quality.
    """
    by_phase = phases(rows)
    tables = [t(of, suffix) for suffix, of in by_phase for t in (_quality, _time, _work)]
    return [table for table in (*tables, _memory(rows)) if table.lines]


def _values(rows: pd.DataFrame, prefix: str = "") -> dict[str, float]:
    """Figures of one run by metric, for metrics with `prefix`, which is removed from the names."""
    some = rows[rows["metric"].str.startswith(prefix)]
    return dict(zip(some["metric"].str.removeprefix(prefix), some["value"], strict=True))


def _quality(rows: pd.DataFrame, suffix: str) -> Table:
    figures = rows.set_index("metric")
    scored, lines = figures["n"]["psnr"], []
    for metric, shown in QUALITY.items():
        if scored and metric in figures.index:
            value, *ends = map(float, figures.loc[metric, ["value", "lo", "hi"]])
            interval = " – ".join(map(shown.write, ends)) if math.isfinite(ends[0]) else ""
            lines.append((shown.heading, shown.write(value), interval))
    title = f"Quality{suffix}, mean of {scored} frames"
    return Table(title, ("metric", "mean", "95 % interval"), lines)


def _time(rows: pd.DataFrame, suffix: str) -> Table:
    value, stages = _values(rows), _values(rows, "stage_ms.")
    lines = []
    if total := value.get("frame_ms"):
        lines = [(name, decimal(ms, 2), share(ms, total)) for name, ms in stages.items()]
        of_stages = share(sum(stages.values()), total) if stages else ""
        lines.append(("frame", decimal(total, 2), of_stages))
        parts = {f"frame, {part}": f"frame_ms.{part}" for part in ("p50", "p95", "p99")}
        others = {**parts, "FPS": "fps", "frame, with the socket": "wall_ms"}
        for name, metric in others.items():
            if metric in value:
                lines.append((name, decimal(value[metric], 2), ""))
    return Table(f"Time of a frame{suffix}", ("stage", "mean ms", "share"), lines)


def _work(rows: pd.DataFrame, suffix: str) -> Table:
    value = _values(rows, "work.")
    lines = []
    for name, done in value.items():
        if not name.endswith(DENSE):
            dense = value.get(f"{name}{DENSE}")
            saved = "" if dense is None else share(dense - done, dense)
            figures = ("" if x is None else decimal(x, 0 if x >= 100 else 1) for x in (done, dense))
            lines.append((name.replace("_", " "), *figures, saved))
    return Table(f"Work of a frame{suffix}", ("work", "done", "dense", "saved"), lines)


def _memory(rows: pd.DataFrame) -> Table:
    sizes = _values(rows, "size_bytes.")
    if sizes:
        sizes["model"] = sizes.pop("total")
    for name, when in (("peak_bytes", "rendering"), ("train_peak_bytes", "training")):
        if math.isfinite(peak := _values(rows).get(name, math.nan)):
            sizes[f"peak, {when}"] = peak
    lines = [(name, megabytes(size)) for name, size in sizes.items()]
    return Table("Memory", ("component", "MB"), lines)

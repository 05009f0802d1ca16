"""The one table in which several runs stand beside each other, a line for each."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial

from reports.runs import Run
from reports.tables import QUALITY, Table, megabytes, number

Write = Callable[[float | None], str]

COST: dict[str, tuple[str, Write]] = {
    "frame_ms": ("ms / frame ↓", partial(number, decimals=1)),
    "fps": ("FPS ↑", partial(number, decimals=2)),
    "size_bytes.total": ("model, MB ↓", megabytes),
    "train_s": ("training, s ↓", partial(number, decimals=0)),
}
"""Label of each figure that is no quality, and how it is written."""

COMMON = ("scene", "resolution", "trajectory", "budget", "protocol", "device")


def comparison(runs: Sequence[Run], failures: Mapping[str, str]) -> Table:
    """One line per run, or per phase of it, then one per failure; the best figures are bold.

    A figure is the best only among runs made under the same conditions, and only where there are
    at least two of them.

    Args:
        runs: what was measured.
        failures: why a run is missing, by its label.
    """
    columns = _columns(runs)
    parts = [part for run in runs for part in run.phases()]
    lines = [
        (part.label, *(write(part.values.get(metric)) for metric, _, write in columns))
        for part in parts
    ]
    bold = frozenset(
        (row, column)
        for column, (metric, label, write) in enumerate(columns, 1)
        for row in best(parts, metric, write, highest=label.endswith("↑"))
    )
    blank = ("",) * len(columns)
    lines += [(f"{label}: failed: {reason}", *blank) for label, reason in failures.items()]
    labels = (label for _, label, _ in columns)
    title = f"Comparison: {setting(runs)}" if runs else "Comparison"
    return Table(title, ("run", *labels), tuple(lines), bold=bold)


def _columns(runs: Sequence[Run]) -> list[tuple[str, str, Write]]:
    """Metric, label and writer of every column; of the qualities, those that any run has."""
    quality: dict[str, tuple[str, Write]] = {
        metric: (label, partial(number, decimals=decimals))
        for metric, (label, decimals) in QUALITY.items()
        if any(metric in run.values for run in runs)
    }
    return [(metric, label, write) for metric, (label, write) in (quality | COST).items()]


def best(runs: Sequence[Run], metric: str, write: Write, highest: bool) -> Iterator[int]:
    """Which of `runs` have the best figure of their conditions, or one written like the best.

    Where only one was made under its conditions, there is no best.
    """
    known: dict[tuple[object, ...], dict[int, float]] = {}
    for row, run in enumerate(runs):
        if math.isfinite(run.values.get(metric, math.nan)):
            known.setdefault(run.conditions, {})[row] = run.values[metric]
    for figures in known.values():
        best = (max if highest else min)(figures.values())
        if len(figures) > 1:
            yield from (row for row, value in figures.items() if write(value) == write(best))


def setting(runs: Sequence[Run]) -> str:
    """Under what the runs were made: what they have in common, or the several there are of it."""
    several = {name: dict.fromkeys(str(run.facts[name]) for run in runs) for name in COMMON}
    return ", ".join(f"{name} {' / '.join(values)}" for name, values in several.items())

"""The one table in which several runs stand beside each other, a line for each."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Protocol

from bench.errors import SteerbenchError
from bench.run import UNITS
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


class Comparable(Protocol):
    """What can be held against others that were made under the same conditions."""

    @property
    def values(self) -> Mapping[str, float]:
        """Figures by metric."""

    @property
    def conditions(self) -> tuple[object, ...]:
        """See `Run.conditions`."""


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
        for column, (metric, _, _) in enumerate(columns, 1)
        for row, place in ranks(parts, metric).items()
        if place == 1
    )
    blank = ("",) * len(columns)
    lines += [(f"{label}: failed: {reason}", *blank) for label, reason in failures.items()]
    labels = (label for _, label, _ in columns)
    title = f"Comparison: {setting(runs)}" if runs else "Comparison"
    return Table(title, ("run", *labels), tuple(lines), bold=bold)


def _columns(runs: Sequence[Run]) -> list[tuple[str, str, Write]]:
    """Metric, label and writer of every column; of the qualities, those that any run has."""
    quality = [metric for metric in QUALITY if any(metric in run.values for run in runs)]
    return [(metric, *written(metric)) for metric in (*quality, *COST)]


def written(metric: str) -> tuple[str, Write]:
    """What the column of a metric is called, with an arrow to better, and how it is written.

    Raises:
        SteerbenchError: there is no such metric.
    """
    if metric in QUALITY:
        label, decimals = QUALITY[metric]
        return label, partial(number, decimals=decimals)
    if metric in COST:
        return COST[metric]
    family, _, rest = metric.partition(".")
    unit = UNITS.get(family)
    if unit is None:
        raise SteerbenchError(
            f"{metric}: no such metric; expected one as `steerbench results` shows them"
        )
    if unit == "B":
        return f"{rest or 'peak memory'}, MB ↓", megabytes
    return f"{rest or family}, {unit} ↓", partial(number, decimals=0 if family == "work" else 2)


def ranks(runs: Sequence[Comparable], metric: str) -> dict[int, int]:
    """The place, from 1, that each of `runs` has among those of its conditions.

    Figures written alike share a place; where only one run was made under its conditions, it has
    none.
    """
    label, write = written(metric)
    known: dict[tuple[object, ...], dict[int, float]] = {}
    for row, run in enumerate(runs):
        if math.isfinite(run.values.get(metric, math.nan)):
            known.setdefault(run.conditions, {})[row] = run.values[metric]
    places: dict[int, int] = {}
    for figures in known.values():
        ordered = sorted(figures.values(), reverse=label.endswith("↑"))
        texts = list(dict.fromkeys(map(write, ordered)))
        if len(figures) > 1:
            places |= {row: texts.index(write(value)) + 1 for row, value in figures.items()}
    return places


def setting(runs: Sequence[Run]) -> str:
    """Under what the runs were made: what they have in common, or the several there are of it."""
    several = {name: dict.fromkeys(str(run.facts[name]) for run in runs) for name in COMMON}
    return ", ".join(f"{name} {' / '.join(values)}" for name, values in several.items())

"""One table of several runs, one line each, with the best figures in bold."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial

from bench.errors import SteerbenchError
from bench.rows import UNITS
from reports.runs import Repeated, Run
from reports.tables import NOT_AVAILABLE, QUALITY, Metric, Table, decimal, megabytes

Write = Callable[[float], str]

COST = {
    "frame_ms": Metric("ms / frame", "↓", partial(decimal, decimals=1)),
    "fps": Metric("FPS", "↑", partial(decimal, decimals=2)),
    "size_bytes.total": Metric("model, MB", "↓", megabytes),
    "train_s": Metric("training, s", "↓", partial(decimal, decimals=0)),
}
"""The columns other than quality metrics."""

COMMON = ("scene", "resolution", "trajectory", "budget", "protocol", "device")
"""Facts that a heading lists."""


def comparison(runs: Sequence[Run], failures: Mapping[str, str]) -> Table:
    """One line per run or per phase of a run, then one per failure; the best figures are bold.

    Figures are ranked only among runs under the same conditions, if there are at least two. A
    quality metric that no run has gets no column. `failures` says why a run is missing, by label.
    """
    metrics = [*(name for name in QUALITY if any(name in run.values for run in runs)), *COST]
    parts = [Repeated(part.label, [part]) for run in runs for part in run.phases()]
    lines = [
        (part.label, *(written(part, metric) or NOT_AVAILABLE for metric in metrics))
        for part in parts
    ]
    bold = frozenset(
        (row, column)
        for column, metric in enumerate(metrics, 1)
        for row, place in ranks(parts, metric).items()
        if place == 1
    )
    blank = ("",) * len(metrics)
    lines += [(f"{label}: failed: {reason}", *blank) for label, reason in failures.items()]
    title = f"Comparison: {conditions_of(runs)}" if runs else "Comparison"
    heads = ("run", *(shown_as(metric).heading for metric in metrics))
    sources = (*(part.keys for part in parts), *(() for _ in failures))
    return Table(title, heads, tuple(lines), bold=bold, sources=sources)


def shown_as(metric: str) -> Metric:
    """How a metric is shown; raises SteerbenchError if there is no such metric."""
    if known := QUALITY.get(metric) or COST.get(metric):
        return known
    family, _, rest = metric.partition(".")
    unit = UNITS.get(family)
    if unit is None:
        raise SteerbenchError(
            f"{metric}: no such metric; expected one as `steerbench results` shows them"
        )
    if unit == "B":
        return Metric(f"{rest or 'peak memory'}, MB", "↓", megabytes)
    decimals = 0 if family == "work" else 2
    return Metric(f"{rest or family}, {unit}", "↓", partial(decimal, decimals=decimals))


def written(line: Repeated, metric: str, write: Write | None = None) -> str | None:
    """The mean of a metric as text, with half its 95 % interval if known; None without a mean.

    Numbers are written by `write`, or in the usual format.
    """
    mean, half = line.mean(metric), line.half(metric)
    write = write or shown_as(metric).write
    if mean is None:
        return None
    return f"{write(mean)} ± {write(half)}" if half > 0 else write(mean)


def marked(
    lines: Sequence[Repeated], metric: str, marks: Sequence[str], write: Write | None = None
) -> list[str | None]:
    """A column: what `written` returns for each line, the best and the second best with `marks`.

    The second of two gets no mark (see `ranks`), and no stage does.
    """
    places = {} if metric.startswith("stage_ms.") else ranks(lines, metric, write)
    forms = dict(enumerate(marks, 1))
    texts = [written(line, metric, write) for line in lines]
    return [text and forms.get(places.get(n, 0), "%s") % text for n, text in enumerate(texts)]


def ranks(lines: Sequence[Repeated], metric: str, write: Write | None = None) -> dict[int, int]:
    """The rank, from 1, of each of `lines` among those under the same conditions, by its index.

    Figures that look the same when written (by `write`, or in the usual format) share a rank. A
    line that is alone under its conditions has no rank, nor has the last of several, so that the
    second of two has none. No line has one in a metric without a better side.
    """
    shown = shown_as(metric)
    if not shown.better:
        return {}
    write = write or shown.write
    known: dict[tuple[object, ...], dict[int, float]] = {}
    for row, line in enumerate(lines):
        mean = line.mean(metric)
        if mean is not None and math.isfinite(mean):
            known.setdefault(line.conditions, {})[row] = mean
    places: dict[int, int] = {}
    for figures in known.values():
        ordered = sorted(figures.values(), reverse=shown.better == "↑")
        texts = list(dict.fromkeys(map(write, ordered)))
        ranked = {row: texts.index(write(value)) + 1 for row, value in figures.items()}
        places |= {row: place for row, place in ranked.items() if place < len(figures)}
    return places


def conditions(runs: Sequence[Run], names: Sequence[str] = COMMON) -> dict[str, str]:
    """The facts `names` of `runs`, each with all of its values."""
    facts = {name: dict.fromkeys(str(run.facts[name]) for run in runs) for name in names}
    return {name: " / ".join(values) for name, values in facts.items()}


def conditions_of(runs: Sequence[Run]) -> str:
    """Scene, resolution, trajectory and so on of `runs`, as text."""
    return ", ".join(map(" ".join, conditions(runs).items()))

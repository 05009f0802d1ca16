"""Tables of several runs, a line for each of their settings, with the best figures in bold."""

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial

import pandas as pd

from bench.errors import SteerbenchError
from bench.rows import UNITS, half_interval
from reports.lines import COMMON, Lines, Settings
from reports.runs import Repeated, Runs, TableLines, conditions, grouped, joined, listed
from reports.tables import BOLD, NOT_AVAILABLE, QUALITY, Metric, Table, decimal, megabytes

Write = Callable[[str, float], str]  # writes a figure of a metric

COST = {
    "frame_ms": Metric("ms / frame", "↓", partial(decimal, decimals=1)),
    "fps": Metric("FPS", "↑", partial(decimal, decimals=2)),
    "size_bytes.total": Metric("model, MB", "↓", megabytes),
    "train_s": Metric("training, s", "↓", partial(decimal, decimals=0)),
}
"""The columns other than quality metrics."""

COLD_FRAMES = (
    "Cold frames: the first of a path, which have fewer preceding frames than the method uses"
)


def comparison(lines: Lines, failures: Mapping[str, str]) -> list[Table]:
    """The figures of `lines`, then those of their cold frames if they have any.

    Figures are ranked only among lines under the same conditions, if there are at least two; the
    best are bold. A quality metric that no run has gets no column. `failures` says why runs are
    missing, by label: each is a line of its own.
    """
    metrics = columns_of(lines)
    where = f": {conditions_of(lines.runs, lines.settings)}" if lines.lines else ""
    tables = [_table(f"Comparison{where}", lines.settings, lines.lines, metrics)]
    blank = ("",) * (len(tables[0].columns) - 1)
    failed = ((f"{label}: failed: {why}", *blank) for label, why in failures.items())
    tables[0] = replace(tables[0], lines=[*tables[0].lines, *failed])
    cold = [replace(x, runs=[run.cold for run in x.runs if run.cold]) for x in lines.lines]
    if kept := [index for index, line in enumerate(cold) if line.runs]:
        settings = {name: [of[index] for index in kept] for name, of in lines.settings.items()}
        of_frames = [name for name in metrics if name in (*QUALITY, "frame_ms")]
        tables.append(_table(COLD_FRAMES, settings, [cold[index] for index in kept], of_frames))
    return tables


def columns_of(lines: Lines) -> list[str]:
    """The metrics that a comparison of `lines` shows."""
    return [*(name for name in QUALITY if any(name in x.values for x in lines.runs)), *COST]


def _table(
    title: str,
    settings: Settings,
    lines: TableLines,
    metrics: Sequence[str],
) -> Table:
    columns = dict(settings)
    phases = [str(line.runs[0].headline["phase"].iloc[0]) for line in lines]
    if len(set(phases)) > 1:  # the path is shorter than the method looks back
        columns["frames"] = phases
    if any(len(line.runs) > 1 for line in lines):
        columns["seeds"] = [str(len(line.runs)) for line in lines]
    for metric in metrics:
        texts = marked(lines, metric, BOLD[:1])
        columns[shown_as(metric).heading] = [text or NOT_AVAILABLE for text in texts]
    return line_table(title, columns, lines)


def line_table(title: str, columns: Mapping[str, Sequence[str]], lines: TableLines) -> Table:
    """A table of `lines` from its `columns`, by their headings."""
    cells = list(zip(*columns.values(), strict=True))
    return Table(title, tuple(columns), cells, [line.keys for line in lines])


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
        peaks = {"peak_bytes": "peak memory", "train_peak_bytes": "peak memory of training"}
        return Metric(f"{rest or peaks.get(family, family)}, MB", "↓", megabytes)
    decimals = 0 if family == "work" else 2
    return Metric(f"{rest or family}, {unit}", "↓", partial(decimal, decimals=decimals))


def usual(metric: str, figure: float) -> str:
    """A figure as pages show it."""
    return shown_as(metric).write(figure)


def written(line: Repeated, metric: str, write: Write = usual) -> str | None:
    """The mean of a metric as text, with half its 95 % interval if known; None without a mean."""
    mean, half = line.mean(metric), line.half(metric)
    if mean is None:
        return None
    return f"{write(metric, mean)} ± {write(metric, half)}" if half > 0 else write(metric, mean)


def marked(
    lines: TableLines, metric: str, marks: Sequence[str], write: Write = usual
) -> list[str | None]:
    """A column: what `written` returns for each line, the best and the second best with `marks`.

    The second of two gets no mark (see `ranks`), and no stage does.
    """
    places = {} if metric.startswith("stage_ms.") else ranks(lines, metric, write)
    forms = dict(enumerate(marks, 1))
    texts = [written(line, metric, write) for line in lines]
    return [text and forms.get(places.get(n, 0), "%s") % text for n, text in enumerate(texts)]


def ranks(lines: TableLines, metric: str, write: Write = usual) -> dict[int, int]:
    """The rank, from 1, of each of `lines` among those under the same conditions, by its index.

    Figures share the rank of a better one from which they differ by no more than the interval over
    seeds, or not when written (by `write`, or in the usual format). The last ones have none: so
    neither lines that are all alike or alone under their conditions have one, nor the second of
    two. No line has one in a metric without a better side.
    """
    better = shown_as(metric).better
    if not better:
        return {}
    means = ((row, line.mean(metric)) for row, line in enumerate(lines))
    known = {row: mean for row, mean in means if mean is not None and not math.isnan(mean)}
    places: dict[int, int] = {}
    for rows in grouped(known, lambda row: lines[row].conditions).values():
        of_rank: list[list[int]] = []  # the best of a rank comes first
        for row in sorted(rows, key=known.__getitem__, reverse=better == "↑"):
            best = lines[of_rank[-1][0]] if of_rank else None
            if best is None or _apart(best, lines[row], metric, write):
                of_rank.append([])
            of_rank[-1].append(row)
        places |= {row: rank for rank, alike in enumerate(of_rank[:-1], 1) for row in alike}
    return places


def _apart(one: Repeated, other: Repeated, metric: str, write: Write) -> bool:
    """Whether two means differ when written, and by more than the interval of their difference:
    over pairs of the same seed or, if the seeds are others, from the intervals of both."""
    low, high = (
        pd.Series({run.facts["seed"]: run.figure(metric) for run in x.runs}, dtype=float).dropna()
        for x in (one, other)
    )
    if write(metric, low.mean()) == write(metric, high.mean()):
        return False
    interval = math.hypot(*(half for x in (one, other) if (half := x.half(metric)) > 0))
    if {*low.index} == {*high.index} and len(low) > 1:
        interval = half_interval((high - low).to_numpy())
    return not abs(high.mean() - low.mean()) <= interval  # nan: of a perfect seed


def machines(runs: Runs) -> str:
    """On which machines `runs` were measured, with how many threads."""
    found = (run.record["machine"] for run in runs)
    return joined(f"{x['cpu']} with {x['threads']} threads" for x in found)


def conditions_of(runs: Runs, without: Collection[str] = ()) -> str:
    """Scene, resolution, trajectory and so on of `runs`, as text, `without` some of them."""
    names = [name for name in COMMON if name not in without]
    return listed(conditions(runs, names))

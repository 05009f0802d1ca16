"""The views of the studies of methods, from stored runs: tables, and the frontier as a plot.

Some lines are measured in several groups, beside others: those that all of them are compared with.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from bench.clock import OTHER
from bench.convergence import observed_order
from bench.kinds import Words
from reports.figures import frontier_plot
from reports.images import Parts, Picture
from reports.runs import Run, conditions, grouped
from reports.tables import BOLD, DENSE, Table, Write, amount, decimal, megabytes, share

WORK = "work."


@dataclass(frozen=True)
class StudyLine:
    """A variant of a method, and with which others it is compared.

    `settings` are words of `steerbench run`; `value` is its place on the axis that the study
    varies. Lines with the same `group` (a knob, an axis) are compared with each other.
    """

    method: str
    group: str
    label: str
    settings: Words = ()
    value: float = math.nan


@dataclass(frozen=True)
class Measured:
    """A line with what was measured of it. Times are in ms a frame, of the lower median round and
    of the fastest and slowest one."""

    line: StudyLine
    run: Run
    ms: float
    fastest: float
    slowest: float
    lost: float = math.nan  # PSNR, against the first line, in dB
    better: StudyLine | None = None  # the best one that takes no longer; none on the frontier

    @classmethod
    def of(cls, line: StudyLine, run: Run) -> Measured:
        values = run.values
        ms = values["frame_ms"]
        fastest, slowest = (values.get(f"frame_ms.{end}", ms) for end in ("fastest", "slowest"))
        return cls(line, run, ms, min(fastest, ms), max(slowest, ms))  # means are rounded

    def figure(self, metric: str) -> float:
        """A figure of the run; nan if it has none."""
        return self.run.values.get(metric, math.nan)

    @property
    def work(self) -> dict[str, float]:
        return {
            metric.removeprefix(WORK): value
            for metric, value in self.run.values.items()
            if metric.startswith(WORK) and not metric.endswith(DENSE)
        }


MeasuredLines = Sequence[Measured]
Columns = Mapping[str, Callable[[Measured], str]]  # what a column says of a line, by its heading


def pooled(found: MeasuredLines) -> list[Measured]:
    """Each line once, with times that can be compared.

    Lines of different groups were not timed in the same minutes. Their times are scaled so that the
    line which all groups have, the last of several, takes as long in each as in their median. Lost
    is the PSNR of the first line less that of a line.
    """
    by_group = grouped(found, lambda each: each.line.group).values()
    groups = [{each.line.settings: each for each in group} for group in by_group]
    lines = dict.fromkeys(each.line.settings for each in found)
    common = [line for line in lines if all(line in group for group in groups)]
    if common:
        usual = statistics.median_low(group[common[-1]].ms for group in groups)
        for group in groups:
            pace = usual / group[common[-1]].ms
            for line, x in group.items():
                ms, fastest, slowest = pace * x.ms, pace * x.fastest, pace * x.slowest
                group[line] = replace(x, ms=ms, fastest=fastest, slowest=slowest)
    once = {}
    for line in lines:
        several = [group[line] for group in groups if line in group]
        middle = statistics.median_low(each.ms for each in several)
        usual_one = next(each for each in several if each.ms == middle)
        ends = min(x.fastest for x in several), max(x.slowest for x in several)
        once[line] = replace(usual_one, fastest=ends[0], slowest=ends[1])
    first = next(iter(once.values())).figure("psnr")
    return [replace(each, lost=first - each.figure("psnr")) for each in once.values()]


def by_method(found: Iterable[Measured]) -> dict[str, list[Measured]]:
    """The `pooled` lines of each method."""
    methods = grouped(found, lambda each: each.line.method)
    return {name: pooled(of) for name, of in methods.items()}


def accuracy(found: MeasuredLines) -> Parts:
    """Run time against error of all settings of a method, fastest first; the frontier is bold."""
    columns: Columns = {
        "ms / frame ↓": lambda line: decimal(line.ms, 1),
        "of rounds": _of_rounds,
        "PSNR, dB ↑": _psnr,
        "lost, dB ↓": lambda line: decimal(line.lost, 2),
        "PSNR to the first, dB ↑": _apart,
        "better at no more time": lambda line: line.better.label if line.better else "— (frontier)",
    }
    for method, lines in by_method(found).items():
        rated = on_frontier(lines)
        fastest_first = sorted(rated, key=lambda line: line.ms)
        best = [line.line for line in rated if line.better is None]
        title = f"{method}: run time against error of a frame,"
        yield _table(title, "setting", columns, fastest_first, best)
        if sum(math.isfinite(line.figure("psnr")) for line in rated) > 1:
            plot = partial(frontier_plot, list(map(_point, rated)))
            shows = f"{method}: error of a frame against its time, one point a setting"
            yield Picture(f"frontier-{method}", shows, plot)


def on_frontier(lines: MeasuredLines) -> list[Measured]:
    """The lines, each with the best one that takes no longer: of the highest PSNR, then the least
    time. On the Pareto frontier that is the line itself."""
    rated = []
    for line in lines:
        no_longer = (each for each in lines if each.ms <= line.ms)
        best = min(no_longer, key=lambda each: (-each.figure("psnr"), each.ms))
        rated.append(line if best is line else replace(line, better=best.line))
    return rated


def _point(line: Measured) -> dict[str, Any]:
    return {
        "setting": line.line.label,
        "knob": line.line.group,
        "unchanged": not line.line.settings,
        "ms": line.ms,
        "ms_lo": line.fastest,
        "ms_hi": line.slowest,
        "psnr": line.figure("psnr"),
        "psnr_to_first": line.figure("psnr_to_first"),
        "frontier": line.better is None,
    }


def parity(found: MeasuredLines) -> Parts:
    """Every engine and precision beside the first, torch in fp32."""
    columns: Columns = {
        **COMPARED,
        "p99 / p50 ↓": _tail,
        "worst pixel ↓": lambda line: decimal(line.figure("worst_to_first"), 4),
        "network, ms ↓": lambda line: decimal(line.run.parts.get("network"), 2),
        "model, MB ↓": partial(_written, "size_bytes.total", megabytes),
    }
    for method, lines in by_method(found).items():
        yield _table(f"{method}: engines and precisions,", "engine, precision", columns, lines)


def skips(found: MeasuredLines) -> Parts:
    """A frame without each of the skips: how it differs, and its work as a share of all work, that
    of the last line."""
    for method, lines in by_method(found).items():
        every = lines[-1].work.items()
        shares = {name.replace("_", " "): partial(_shared, name, of) for name, of in every}
        title = f"{method}: mean work of a frame, and its share of all;"
        yield _table(title, "skipped", {**COMPARED, **shares}, lines)


def breakdown(found: MeasuredLines) -> Parts:
    """The ms of a frame that each of its parts takes itself, and where the host waits for a GPU."""
    there = dict.fromkeys(part for line in found for part in line.run.parts)
    columns: Columns = {
        **{part: partial(_part_ms, part) for part in there if part != OTHER},
        OTHER: partial(_part_ms, OTHER),
        "frame ↓": lambda line: decimal(line.ms, 1),
        "of rounds": _of_rounds,
        "p99 / p50 ↓": _tail,
        "FPS ↑": lambda line: decimal(1e3 / line.ms, 2),
        "PSNR, dB ↑": _psnr,
    }
    title = "ms of a frame, and what of it each part takes itself;"
    yield _table(title, "", columns, found)
    for line in found:
        if waits := line.run.record["waits"]:
            total = decimal(sum(each["waits"] for each in waits), 1)
            rows = [(decimal(x["waits"], 1), x["line"], x["source"]) for x in waits]
            title = f"{line.line.label}: {total} waits for the GPU a frame"
            yield Table(title, ("waits", "line", "source"), rows)


def scaling(found: MeasuredLines) -> Parts:
    """How time, work and memory of a frame grow along each axis: all lines, and below those of an
    axis the exponent of each figure."""
    for method, lines in grouped(found, lambda each: each.line.method).items():
        yield _scaling_table(method, lines)


def _scaling_table(method: str, every: MeasuredLines) -> Table:
    counters = dict.fromkeys(name for line in every for name in line.work)
    figures: dict[str, tuple[str, Write]] = {
        "frame_ms": ("ms / frame ↓", partial(decimal, decimals=1)),
        **{f"{WORK}{name}": (name.replace("_", " "), amount) for name in counters},
        "peak_bytes": ("peak, MB ↓", megabytes),
        "size_bytes.total": ("model, MB ↓", megabytes),
    }
    columns: Columns = {
        **{head: partial(_written, name, write) for name, (head, write) in figures.items()},
        "p99 / p50 ↓": _tail,
    }
    cells: list[Sequence[str]] = []
    sources: list[Sequence[str]] = []
    for axis, lines in grouped(every, lambda line: line.line.group).items():
        of_axis, values = _table("", "", columns, lines), [line.line.value for line in lines]
        powers = (growth(values, [line.figure(name) for line in lines]) for name in figures)
        exponents = (f"exponent of {axis}", *(decimal(power, 2) for power in powers), "")
        cells += [*of_axis.lines, exponents]
        sources += [*of_axis.sources, ()]
    return replace(_table(f"{method}:", "", columns, every), lines=cells, sources=sources)


VIEWS: Mapping[str, Callable[[MeasuredLines], Parts]] = {
    view.__name__: view for view in (accuracy, parity, skips, breakdown, scaling)
}
"""What each study shows of the lines that were measured, by the name of the study."""


def _table(
    title: str,
    head: str,
    columns: Columns,
    lines: MeasuredLines,
    best: Collection[StudyLine] = (),
) -> Table:
    """The `lines` below `head`, the `best` in bold, and what each of the `columns` says of them."""
    cells = []
    for each in lines:
        label = BOLD[0] % each.line.label if each.line in best else each.line.label
        cells.append([label, *(write(each) for write in columns.values())])
    sources = [[each.run.key] for each in lines]
    return Table(f"{title} {_where(lines)}", (head, *columns), cells, sources)


def _apart(line: Measured) -> str:
    """The PSNR to the pictures of the first line."""
    apart = line.figure("psnr_to_first")
    return "the same" if apart == math.inf else decimal(apart, 1)


def _written(metric: str, write: Write, line: Measured) -> str:
    return write(line.figure(metric))


def _psnr(line: Measured) -> str:
    return decimal(line.figure("psnr"), 2)


def _of_rounds(line: Measured) -> str:
    return f"{decimal(line.fastest, 1)} – {decimal(line.slowest, 1)}"


def _tail(line: Measured) -> str:
    """How much longer the slowest frames take: 99th percentile over the median."""
    return decimal(line.figure("frame_ms.p99") / line.figure("frame_ms.p50"), 2)


def _part_ms(part: str, line: Measured) -> str:
    return decimal(line.run.parts.get(part, 0.0), 1)


def _shared(counter: str, of: float, line: Measured) -> str:
    done = line.work.get(counter, 0.0)
    return f"{amount(done)} ({share(done, of)})"


COMPARED: Columns = {
    "PSNR to the first, dB ↑": _apart,
    "PSNR, dB ↑": _psnr,
    "lost, dB ↓": lambda line: decimal(line.lost, 3),
    "frame, ms ↓": lambda line: decimal(line.ms, 1),
    "of rounds": _of_rounds,
}


def _where(lines: MeasuredLines) -> str:
    """Scene, path and size of the frames."""
    facts = conditions([line.run for line in lines], ("scene", "trajectory", "resolution"))
    return ", ".join(fact for fact in facts.values() if " / " not in fact)


def growth(values: Sequence[float], figures: Sequence[float]) -> float:
    """The exponent p of figure ~ value^p by least squares on the logarithms; nan if fewer than two
    distinct values have a figure above 0."""
    used = [(v, f) for v, f in zip(values, figures, strict=True) if v > 0 and f > 0]
    if len({value for value, _ in used}) < 2:
        return math.nan
    return observed_order(*zip(*used, strict=True))

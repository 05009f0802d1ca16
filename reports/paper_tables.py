"""The tables of the paper, read from `paper/table*.toml`, and measured figures beside them."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from reports.comparison import conditions_of, metric_format, ranks
from reports.page import missing_figures
from reports.runs import Repeated, Run
from reports.tables import Table
from reports.trends import Trend, steps, trend_table

FOLDER = Path(__file__).parent / "paper"
ABSENT = "–"
"""In place of a figure that the paper does not give or that nothing here can measure."""


@dataclass(frozen=True)
class Line:
    """A line of a table.

    Attributes:
        label: its name.
        job: the settings that measure it, beside those of all lines; None if no method here does.
        published: the paper's figures by metric; bytes, ms, dB as in our rows.
    """

    label: str
    job: Mapping[str, str] | None = None
    published: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class PaperTable:
    """A table of the paper.

    Attributes:
        name: that of the experiment that measures it.
        title: what it shows.
        published_on: scenes, size and machine of the paper's figures.
        metrics: its columns.
        lines: in the paper's order.
        notes: what a reader should know before comparing.
        trends: what the paper concludes from it.
    """

    name: str
    title: str
    published_on: str
    metrics: Sequence[str]
    lines: Sequence[Line]
    notes: Sequence[str]
    trends: Sequence[Trend] = ()


def paper_tables() -> list[PaperTable]:
    """All tables, in the paper's order."""
    paths = sorted(FOLDER.glob("table*.toml"), key=lambda path: (len(path.stem), path.stem))
    return [_table(path) for path in paths]


def _table(path: Path) -> PaperTable:
    content = tomllib.loads(path.read_text(encoding="utf-8"))
    lines = [Line(**line) for line in content.pop("line")]
    trends = [Trend(**trend) for trend in content.pop("trend", [])]
    notes = content.pop("notes", [])
    return PaperTable(path.stem, lines=lines, notes=notes, trends=trends, **content)


def with_published(table: PaperTable, measured: Mapping[str, Repeated]) -> Table:
    """Measured figures, the paper's and their difference.

    The best measured figure of a column is bold, the second of at least three italic, among those
    of the same conditions.

    Args:
        table: of the paper.
        measured: by the label of a line; lines may be missing.
    """
    lines = [measured.get(line.label, Repeated(line.label, ())) for line in table.lines]
    columns = []
    for metric in table.metrics:
        places = {} if metric.startswith("stage_ms.") else ranks(lines, metric)
        marks = {1: "**", 2: "*" if len(places) > 2 else ""}
        columns.append(
            [
                _cell(found, line.published.get(metric), metric, marks.get(places.get(row, 0), ""))
                for row, (found, line) in enumerate(zip(lines, table.lines, strict=True))
            ]
        )
    names = [": ".join((line.label, *line.gaps)) for line in lines]
    title = f"{table.name.replace('table', 'Table ')}: {table.title}"
    labels = (metric_format(metric)[0] for metric in table.metrics)
    heads = ("measured / paper / difference", *labels)
    return Table(title, heads, tuple(zip(names, *columns, strict=True)))


def section(table: PaperTable, lines: Sequence[Repeated]) -> str:
    """A table as a part of a page: conditions of both, the figures, trends, notes."""
    measured = {line.label: line for line in lines}
    shown = with_published(table, measured)
    parts = [f"## {shown.title}"]
    runs = [run for line in lines for run in line.runs]
    if runs:
        parts.append(f"Measured: {conditions_of(runs)}, {_origin(runs)}.")
    parts.append(f"Paper: {table.published_on}.")
    parts.append(shown.markdown())
    published = {line.label: line.published for line in table.lines}
    if found := [step for trend in table.trends for step in steps(trend, measured, published)]:
        parts.append(trend_table(found).markdown())
    notes = dict.fromkeys((*table.notes, *missing_figures(runs)))
    parts.append("\n".join(f"- {note}" for note in notes))
    return "\n\n".join(filter(None, parts))


def _origin(runs: Sequence[Run]) -> str:
    """Methods, seeds, commits and processors of `runs`."""
    machines = [run.record["machine"] for run in runs]
    origin = {
        "method": [run.facts["method"] for run in runs],
        "seed": [str(run.facts["seed"]) for run in runs],
        "commit": [run.facts["commit"] for run in runs],
        "on": [f"{each['cpu']} with {each['threads']} threads" for each in machines],
    }
    return ", ".join(f"{name} {' / '.join(dict.fromkeys(of))}" for name, of in origin.items())


def _cell(found: Repeated, published: float | None, metric: str, mark: str) -> str:
    """Measured, published and their difference; `mark` goes around the first."""
    measured, (_, write) = found.mean(metric), metric_format(metric)
    if measured is None and published is None:
        return ABSENT
    texts = [ABSENT if figure is None else write(figure) for figure in (measured, published)]
    if found.half(metric) > 0:
        texts[0] += f" ± {write(found.half(metric))}"
    texts[0] = f"{mark}{texts[0]}{mark}"
    if measured is not None and published is not None and not math.isnan(measured):
        sign = "-" if measured < published else "+"
        texts.append(f"{sign}{write(abs(measured - published))}")
    return " / ".join(texts)

"""The tables of the SteerNeRF paper, and what was measured in their place."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from reports import trends
from reports.comparison import ranks, setting, written
from reports.runs import Run
from reports.seeds import Repeated
from reports.tables import Table
from reports.trends import Trend

FOLDER = Path(__file__).parent / "paper"
ABSENT = "–"
"""In place of a figure that the paper does not give, or that there is nothing to measure with."""


@dataclass(frozen=True)
class Line:
    """A line of a table.

    Attributes:
        label: what it is called.
        job: the settings that make it, beside those of all lines; None where no method here is
            that of the line.
        published: the paper's figures by metric; bytes, ms, dB as in our rows.
    """

    label: str
    job: Mapping[str, str] | None = None
    published: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class PaperTable:
    """A table of the paper.

    Attributes:
        name: as the experiment that measures it is called.
        title: what it shows.
        published_on: on what the paper measured it.
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
    """All of them, in the paper's order."""
    return [
        _table(path)
        for path in sorted(FOLDER.glob("table*.toml"), key=lambda path: (len(path.stem), path.stem))
    ]


def _table(path: Path) -> PaperTable:
    content = tomllib.loads(path.read_text(encoding="utf-8"))
    lines = [Line(**line) for line in content.pop("line")]
    trends = [Trend(**trend) for trend in content.pop("trend", [])]
    notes = content.pop("notes", [])
    return PaperTable(path.stem, lines=lines, notes=notes, trends=trends, **content)


def beside(table: PaperTable, measured: Mapping[str, Repeated]) -> Table:
    """What was measured beside what the paper gives, and the difference, in Markdown.

    The best measured figure of a column is bold, the second of at least three italic, among those
    that may be compared.

    Args:
        measured: by the label of a line; a line without one has nothing to be measured with.
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
    heads = ("measured / paper / difference", *(written(metric)[0] for metric in table.metrics))
    return Table(title, heads, tuple(zip(names, *columns, strict=True)))


def section(table: PaperTable, lines: Sequence[Repeated]) -> str:
    """A table as a part of a page: what was measured where, the figures, trends, notes."""
    measured = {line.label: line for line in lines}
    shown = beside(table, measured)
    parts = [f"## {shown.title}"]
    runs = [run for line in lines for run in line.runs]
    if runs:
        parts.append(f"Measured: {setting(runs)}, {_origin(runs)}.")
    parts.append(f"Paper: {table.published_on}.")
    parts.append(shown.markdown())
    if found := [step for trend in table.trends for step in trends.steps(trend, measured)]:
        parts.append(trends.table(found).markdown())
    missing = (f"{name}: n/a. {why}" for run in runs for name, why in run.record["missing"].items())
    parts.append("\n".join(f"- {note}" for note in dict.fromkeys((*table.notes, *missing))))
    return "\n\n".join(filter(None, parts))


def _origin(runs: Sequence[Run]) -> str:
    """Methods, seeds, commits and processors of `runs`."""
    machines = [run.record["machine"] for run in runs]
    told = {
        "method": [run.facts["method"] for run in runs],
        "seed": [str(run.facts["seed"]) for run in runs],
        "commit": [run.facts["commit"] for run in runs],
        "on": [f"{each['cpu']} with {each['threads']} threads" for each in machines],
    }
    return ", ".join(f"{name} {' / '.join(dict.fromkeys(of))}" for name, of in told.items())


def _cell(found: Repeated, published: float | None, metric: str, mark: str) -> str:
    measured, write = found.mean(metric), written(metric)[1]
    if measured is None and published is None:
        return ABSENT
    told = [ABSENT if figure is None else write(figure) for figure in (measured, published)]
    if found.half(metric) > 0:
        told[0] += f" ± {write(found.half(metric))}"
    told[0] = f"{mark}{told[0]}{mark}"
    if measured is None or published is None or math.isnan(measured):
        return " / ".join(told)
    difference = write(abs(measured - published))
    return " / ".join((*told, f"{'-' if measured < published else '+'}{difference}"))

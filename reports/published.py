"""The tables of the SteerNeRF paper, and what was measured in their place."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from reports.comparison import COST, best, setting
from reports.runs import Run
from reports.tables import QUALITY, Table, number

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
    """

    name: str
    title: str
    published_on: str
    metrics: Sequence[str]
    lines: Sequence[Line]
    notes: Sequence[str]


def paper_tables() -> list[PaperTable]:
    """All of them, in the paper's order."""
    return [_table(path) for path in sorted(FOLDER.glob("table*.toml"))]


def _table(path: Path) -> PaperTable:
    content = tomllib.loads(path.read_text(encoding="utf-8"))
    lines = [Line(**line) for line in content.pop("line")]
    return PaperTable(path.stem, lines=lines, notes=content.pop("notes", []), **content)


def beside(
    table: PaperTable, runs: Mapping[str, Run], failures: Mapping[str, str] | None = None
) -> Table:
    """What was measured beside what the paper gives, and the difference.

    Args:
        runs: by the label of a line; lines without one have nothing measured.
        failures: why a line has none, by its label.
    """
    columns = [(metric, *_written(metric)) for metric in table.metrics]
    rows = [row for row, line in enumerate(table.lines) if line.label in runs]
    there = [runs[table.lines[row].label] for row in rows]
    bold = frozenset(
        (rows[place], column)
        for column, (metric, label, write) in enumerate(columns, 1)
        if not metric.startswith("stage_ms.")
        for place in best(there, metric, write, highest=label.endswith("↑"))
    )
    lines = []
    for line in table.lines:
        run, why = runs.get(line.label), (failures or {}).get(line.label)
        cells = (
            _cell(_measured(run, metric), line.published.get(metric), write)
            for metric, _, write in columns
        )
        label = f"{line.label}: failed: {why}" if why else line.label
        lines.append((label, *cells))
    title = f"{table.name.replace('table', 'Table ')}: {table.title}"
    heads = ("measured / paper / difference", *(label for _, label, _ in columns))
    return Table(title, heads, tuple(lines), bold=bold)


def section(
    table: PaperTable, runs: Mapping[str, Run], failures: Mapping[str, str] | None = None
) -> str:
    """A table as a part of a page: what was measured where, the figures, the notes."""
    shown = beside(table, runs, failures)
    parts = [f"## {shown.title}"]
    if runs:
        parts.append(f"Measured: {setting(list(runs.values()))}, {_origin(list(runs.values()))}.")
    parts.append(f"Paper: {table.published_on}.")
    parts.append(shown.markdown())
    parts += [f"- {note}" for note in table.notes]
    return "\n\n".join(parts)


def _origin(runs: Sequence[Run]) -> str:
    """Seeds, commits and processors of `runs`."""
    machines = [run.record["machine"] for run in runs]
    told = {
        "seed": [str(run.facts["seed"]) for run in runs],
        "commit": [run.facts["commit"] for run in runs],
        "on": [f"{each['cpu']} with {each['threads']} threads" for each in machines],
    }
    return ", ".join(f"{name} {' / '.join(dict.fromkeys(of))}" for name, of in told.items())


def _measured(run: Run | None, metric: str) -> float | None:
    """A figure of `run`, if there is one; that of a stage with the stages inside it."""
    if run is None:
        return None
    inside = [value for name, value in run.values.items() if name.startswith(f"{metric}/")]
    if metric in run.values or inside:
        return run.values.get(metric, 0.0) + sum(inside)
    return None


def _cell(
    measured: float | None, published: float | None, write: Callable[[float | None], str]
) -> str:
    if measured is None and published is None:
        return ABSENT
    told = [ABSENT if figure is None else write(figure) for figure in (measured, published)]
    if measured is None or published is None or math.isnan(measured):
        return " / ".join(told)
    difference = write(abs(measured - published))
    return " / ".join((*told, f"{'-' if measured < published else '+'}{difference}"))


def _written(metric: str) -> tuple[str, Callable[[float | None], str]]:
    """Label of a column and how its figures are written."""
    if metric in QUALITY:
        label, decimals = QUALITY[metric]
        return label, partial(number, decimals=decimals)
    if metric in COST:
        return COST[metric]
    return f"{metric.removeprefix('stage_ms.')}, ms ↓", partial(number, decimals=2)

"""The paper's tables, as experiments declare them: measured figures beside the published."""

from __future__ import annotations

import math
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from reports.comparison import COMMON, conditions_of, marked, metric_format, written
from reports.runs import Repeated, missing_figures
from reports.tables import NOT_AVAILABLE, Table
from reports.trends import Trend, differences, signed, trend_table

METHOD = "method"
AFTER, SHARES = "method.after", (0.125, 0.25, 0.5)
"""The setting for the share of the training after which a method is rendered, and the shares that
curves show besides the end."""
OF_CURVES = {"protocol.name": "psnr", "protocol.lpips": "[]"}
"""Curves need only PSNR; at 200x200 LPIPS would take most of a frame's time."""
ABSENT = "–"  # stands for a figure that the paper does not give or that cannot be measured here

Lines = Mapping[str, Sequence[Repeated]]
"""The measured lines of each table, by table name."""


@dataclass(frozen=True)
class Line:
    """A line of a table: `job` has its settings, beside those of all lines; the paper's figures.

    Without a `method` it is one of the paper's method. Units are bytes, ms and dB, as in our rows.
    """

    label: str
    job: Mapping[str, str]
    published: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class PaperTable:
    """A table of the paper, measured by the experiment `name`; `metrics` are its columns.

    `published_on` has scenes, size and machine of the paper's figures. `notes` are what a reader
    should know before comparing, `trends` what the paper concludes. `beyond` is a method beyond the
    paper, shown with the same lines as the paper's method and notes of its own. The metrics
    `scenes` are also shown for every scene of a data set. Where a table compares times, the lines
    of a block are measured `in_turns`, frame by frame. With `curve`, the lines of the paper's
    method are also shown as curves over the training.
    """

    name: str
    title: str
    published_on: str
    metrics: Sequence[str]
    lines: Sequence[Line]
    notes: Sequence[str] = ()
    trends: Sequence[Trend] = ()
    beyond: str | None = None
    beyond_notes: Sequence[str] = ()
    scenes: Sequence[str] = ()
    in_turns: bool = False
    curve: bool = False

    @property
    def number(self) -> str:
        """The table's number in the paper: "Table 3"."""
        return self.name.replace("table", "Table ")

    @property
    def marks(self) -> dict[tuple[str, float], Line]:
        """The lines added for curves, by the label of a line and the share of its training."""
        return {
            (line.label, share): Line(
                f"{line.label}, after {share}", {**line.job, AFTER: str(share), **OF_CURVES}
            )
            for line in self.lines
            for share in SHARES
            if self.curve
        }

    @property
    def blocks(self) -> list[PaperTable]:
        """The table, then the lines and trends of the paper's method for the one beyond it."""
        if self.beyond is None:
            return [self]
        of_paper = [line for line in self.lines if METHOD not in line.job]
        names = {line.label: f"{line.label} ({self.beyond})" for line in of_paper}
        trends = [
            Trend(trend.metric, [names.get(label, label) for label in trend.rising])
            for trend in self.trends
        ]
        second = replace(
            self,
            title=f"Beyond the paper: {self.beyond}",
            lines=[Line(names[line.label], {**line.job, METHOD: self.beyond}) for line in of_paper],
            notes=self.beyond_notes,
            trends=trends,
            beyond=None,
            curve=False,
        )
        return [self, second]

    def shown(self, measured: Container[str]) -> list[PaperTable]:
        """The table, and its other block if any of the lines `measured` (labels) is there."""
        first, *further = self.blocks
        return [first, *(x for x in further if any(line.label in measured for line in x.lines))]

    def measured(self, known: Mapping[str, Repeated]) -> list[Repeated]:
        """Its lines of `known`, by label; those that are not there have no runs."""
        return [known.get(line.label, Repeated(line.label, ())) for line in self.lines]


def paper_tables(folder: Path) -> list[PaperTable]:
    """The tables that the experiments in `folder` declare, in the paper's order."""
    paths = sorted(folder.glob("table*.yaml"), key=lambda path: (len(path.stem), path.stem))
    return [_table(path) for path in paths]


def _table(path: Path) -> PaperTable:
    """What an experiment declares below `table`; what its lines leave out follows from its grid.

    Without jobs of their own, there is a line for each value of the grid. The method beyond the
    paper is the one that the grid has besides that of the experiment and those that lines name.
    """
    experiment: Any = OmegaConf.to_container(OmegaConf.load(path))
    content = experiment["table"]
    params = experiment["hydra"]["sweeper"]["params"]
    grid = {name: str(values).split(",") for name, values in params.items()}
    _, *further = grid.pop(METHOD, [""])
    declared, label = content.pop("lines"), content.pop("label", "{}")
    jobs = [line["job"] for line in declared if "job" in line] or [
        {name: value} for name, values in grid.items() for value in values
    ]
    lines = []
    for line, job in zip(declared, jobs, strict=True):
        paper = zip(content["metrics"], line.get("published", ()), strict="published" in line)
        figures = {metric: figure for metric, figure in paper if figure is not None}
        lines.append(Line(line.get("label") or label.format(*job.values()), job, figures))
    trends = [Trend(metric, labels) for metric, labels in content.pop("rising").items()]
    named = {job.get(METHOD) for job in jobs}
    beyond = next((method for method in further if method not in named), None)
    return PaperTable(path.stem, lines=lines, trends=trends, beyond=beyond, **content)


def section(table: PaperTable, lines: Sequence[Repeated]) -> list[str | Table]:
    """A table as parts of a page: the paper's lines, those of a method beyond it, each scene."""
    measured = {line.label: line for line in lines}
    parts: list[str | Table] = []
    for block in table.shown(measured):
        first = block is table
        parts.append(f"## {table.number}: {table.title}" if first else f"### {block.title}")
        parts += _block(block, measured, f"Paper: {table.published_on}." if first else "")
    if table.scenes and len({scene for line in lines for scene in line.by_scene}) > 1:
        parts += ["### Each scene", _scenes(table.scenes, lines)]
    return parts


def _block(
    table: PaperTable, measured: Mapping[str, Repeated], published: str
) -> list[str | Table]:
    """Conditions of the measured and the published figures, then the figures, trends, notes."""
    figures = {line.label: line.published for line in table.lines}
    runs = [run for line in table.measured(measured) for run in line.runs]
    machines = [run.record["machine"] for run in runs]
    on = dict.fromkeys(f"{each['cpu']} with {each['threads']} threads" for each in machines)
    facts = conditions_of(runs, (*COMMON, "method", "seed", "commit"))
    where = f"Measured: {facts}, on {' / '.join(on)}." if runs else ""
    grown = [each for trend in table.trends for each in differences(trend, measured, figures)]
    trends = trend_table(grown) if grown else ""
    notes = dict.fromkeys((*table.notes, *missing_figures(runs)))
    listed = "\n".join(f"- {note}" for note in notes)
    shown = with_published(table, measured)
    return [part for part in (where, published, shown, trends, listed) if part]


def with_published(table: PaperTable, measured: Mapping[str, Repeated]) -> Table:
    """A table of measured figures (lines by label), the paper's figures and their differences.

    Among measured figures under the same conditions, the best of a column is bold and, of at least
    three, the second best is italic.
    """
    lines = table.measured(measured)
    beside = any(line.published for line in table.lines)
    columns = []
    for metric in table.metrics:
        texts = [text or ABSENT for text in marked(lines, metric, ("**%s**", "*%s*"))]
        if beside:
            texts = [
                _beside(text, found.mean(metric), line.published.get(metric), metric)
                for text, found, line in zip(texts, lines, table.lines, strict=True)
            ]
        columns.append(texts)
    names = [": ".join((line.label, *line.gaps)) for line in lines]
    labels = (metric_format(metric)[0] for metric in table.metrics)
    heads = ("measured / paper / difference" if beside else "measured", *labels)
    cells = tuple(zip(names, *columns, strict=True))
    return Table(table.title, heads, cells, sources=tuple(line.keys for line in lines))


def _scenes(metrics: Sequence[str], lines: Sequence[Repeated]) -> Table:
    """Means over seeds, one line per scene and line."""
    shown = [
        (f"{scene}: {line.label}", Repeated(line.label, line.by_scene[scene]))
        for scene in sorted({scene for line in lines for scene in line.by_scene})
        for line in lines
        if scene in line.by_scene
    ]
    cells = tuple(
        (name, *(written(of_scene, metric) or NOT_AVAILABLE for metric in metrics))
        for name, of_scene in shown
    )
    heads = ("measured", *(metric_format(metric)[0] for metric in metrics))
    return Table("Each scene", heads, cells, sources=tuple(of_scene.keys for _, of_scene in shown))


def _beside(text: str, measured: float | None, published: float | None, metric: str) -> str:
    """A cell: the measured figure (as `text`), the published one and their difference."""
    if measured is None and published is None:
        return ABSENT
    _, write = metric_format(metric)
    texts = [text, ABSENT if published is None else write(published)]
    if measured is not None and published is not None and not math.isnan(measured):
        texts.append(signed(measured - published, write))
    return " / ".join(texts)

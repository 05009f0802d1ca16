"""Tables that experiments declare: measured figures, and distances beside the paper's own."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from bench.records import without
from reports.claims import Claim, Comparison, apart, compare, gap, told
from reports.comparison import line_table, machines, marked, shown_as, written
from reports.lines import COMMON
from reports.runs import Repeated, Runs, TableLines, conditions, listed, missing_figures
from reports.tables import ABSENT, BOLD, Table

METHOD = "method"  # the setting of a line that is another method


class Place(NamedTuple):
    """Where a line is: the name of its table, the data set of its block, its key."""

    table: str
    block: str
    line: str


Measured = Mapping[Place, Repeated]  # what was measured of each line that was planned


@dataclass(frozen=True)
class Line:
    """A line of a table: `job` has its settings, beside those of all lines; the paper's figures, by
    data set and metric.

    Without a `method` it is one of the experiment's method, which is measured with every seed; so
    are others with `every_seed`. Units are bytes, ms and dB, as in our rows. Claims have the words
    that it is `called`, by default the label. An `added` line is none of those declared.
    """

    label: str
    job: Mapping[str, str]
    published: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    every_seed: bool = False
    called: str = ""
    added: bool = False


@dataclass(frozen=True)
class PaperTable:
    """A table, measured by the experiment `name`; `metrics` are its columns, `lines` have keys.

    It has a `number` in the paper, or is one of ours. It is compared with the paper's figures on
    `data_sets`, "" if there are none: all lines with those on the first, the lines `beside` (none:
    all) with those on others. `published_on` has scenes, size and machine of these figures, by data
    set. `notes` are what a reader should know before comparing, `claims` what the paper concludes;
    in what a claim says, {KEY} is what this line is called. Distances are those to the line
    `reference`, by default the first. For a line that was not measured stands the one that
    `instead` has for it. The metrics `scenes` are also shown for every scene of a data set.
    """

    name: str
    title: str
    metrics: Sequence[str]
    lines: Mapping[str, Line]
    data_sets: Sequence[str] = ("",)
    published_on: Mapping[str, str] = field(default_factory=dict)
    beside: Sequence[str] = ()
    number: int | None = None
    notes: Sequence[str] = ()
    claims: Sequence[Claim] = ()
    scenes: Sequence[str] = ()
    reference: str = ""
    instead: Mapping[str, str] = field(default_factory=dict)

    @property
    def called(self) -> str:
        """What the paper calls it, "Table 3"; of another table, the title."""
        return self.title if self.number is None else f"Table {self.number}"

    @property
    def blocks(self) -> dict[str, Mapping[str, Line]]:
        """The lines that are compared with the figures on each data set, by key."""
        first, *further = self.data_sets
        some = {key: self.lines[key] for key in self.beside or self.lines}
        return {first: self.lines, **dict.fromkeys(further, some)}

    def measured(self, key: str, known: Measured) -> Repeated | None:
        """What was measured of a line of the first block; None if it was not planned."""
        return known.get(Place(self.name, self.data_sets[0], key))

    def shown(self, measured: Measured) -> list[Shown]:
        """The first block, and those further ones of which any line is in `measured`."""
        there = {place.block for place in measured if place.table == self.name}
        there.add(self.data_sets[0])
        return [self._shown(x, measured) for x in self.data_sets if x in there]

    def _shown(self, data_set: str, measured: Measured) -> Shown:
        """With the line that `instead` has for one that was not measured, and a note about it."""
        lines = dict(self.blocks[data_set])
        found = {
            key: measured.get(Place(self.name, data_set, key), Repeated(line.label, ()))
            for key, line in lines.items()
        }
        called = {key: line.called or line.label for key, line in self.lines.items()}
        there = {key for key, line in found.items() if line.runs}
        notes, standing = list(self.notes), {}
        for missing, other in self.instead.items():
            if missing in lines.keys() - there and other in there:
                line, gaps = lines.pop(missing), found.pop(missing).gaps
                lines[other] = replace(lines[other], published=line.published)
                standing[missing], called[missing] = other, called[other]
                why = ": ".join(gaps) or "not measured"
                notes.append(f'"{lines[other].label}" stands for "{line.label}" ({why}).')
        claims = []
        for claim in self.claims:
            keys = [standing.get(key, key) for key in claim.lines]
            says = re.sub(r"\{([^{}]+)\}", lambda key: called.get(key[1], key[0]), claim.says)
            claims.append(replace(claim, lines=keys, says=says))
        return Shown(self, data_set, lines, found, claims, notes)


@dataclass(frozen=True)
class Shown:
    """A block of a table as a page shows it: its lines and what was measured of each, by key."""

    table: PaperTable
    data_set: str
    lines: Mapping[str, Line]
    measured: Mapping[str, Repeated]
    claims: Sequence[Claim]
    notes: Sequence[str]

    @property
    def title(self) -> str:
        """The data set; of the first block, which has the title of the table, ""."""
        return "" if self.data_set == self.table.data_sets[0] else self.data_set

    def published(self, metric: str) -> dict[str, float]:
        """The paper's figures, by key, of the lines that have one."""
        figures = {key: line.published.get(self.data_set, {}) for key, line in self.lines.items()}
        return {key: of[metric] for key, of in figures.items() if metric in of}


def comparisons(table: PaperTable, measured: Measured) -> list[Comparison]:
    """What the paper concludes from a table, compared with what was measured here."""
    return [
        replace(each, table=table.called, data_set=block.title)
        for block in table.shown(measured)
        for claim in block.claims
        for each in compare(claim, block.measured, block.published(claim.metric))
    ]


def measured_where(runs: Runs) -> dict[str, str]:
    """Under which conditions, and on which machines, `runs` were measured."""
    return {**conditions(runs, (*COMMON, "seed", "commit")), "machine": machines(runs)}


def section(
    table: PaperTable, measured: Measured, said: Collection[str] = ()
) -> Iterator[str | Table]:
    """A table as parts of a page: the lines of its blocks, and those of each scene.

    The page has `said` some of where they were measured already.
    """
    heading = table.title if table.number is None else f"{table.called}: {table.title}"
    for block in table.shown(measured):
        yield f"### {block.title}" if block.title else f"## {heading}"
        yield from _block(block, said)
    own = [line for key in table.lines if (line := table.measured(key, measured))]
    if table.scenes and len({scene for line in own for scene in line.by_scene}) > 1:
        yield "### Each scene"
        yield _scenes(table.scenes, own)


def _block(block: Shown, said: Collection[str]) -> Iterator[str | Table]:
    """What was measured, under which conditions; distances, here and in the paper; notes.

    All figures are shown where lines are methods, or where there are no distances. Notes are those
    of the table below its first block, and those on figures that could not be measured.
    """
    table, runs = block.table, [run for line in block.measured.values() for run in line.runs]
    facts = without(measured_where(runs), said)
    if runs and facts:
        yield f"Measured: {listed(facts)}."
    published = any(line.published.get(block.data_set) for line in block.lines.values())
    if not published or any(METHOD in line.job for line in block.lines.values()):
        yield figure_table(block)
    if published:
        yield f"Paper: {table.published_on[block.data_set]}."
        yield distance_table(block)
    if notes := dict.fromkeys((*(() if block.title else block.notes), *missing_figures(runs))):
        yield "\n".join(f"- {note}" for note in notes)


def figure_table(block: Shown) -> Table:
    """A table of measured figures.

    Among measured figures under the same conditions, the best of a column is bold and, of at least
    three, the second best is italic.
    """
    lines = list(block.measured.values())
    columns = {metric: marked(lines, metric, BOLD) for metric in block.table.metrics}
    return _of_columns(block.title or block.table.title, "measured", lines, columns)


def distance_table(block: Shown) -> Table:
    """The figures of the table's reference, then how far each line is from it, here and in the
    paper, by metric."""
    runs = dict(block.measured)
    wanted = block.table.reference, block.table.instead.get(block.table.reference), *runs
    first = next(key for key in wanted if key in runs)
    reference = runs.pop(first)
    columns = {}
    for metric in block.table.metrics:
        published = block.published(metric)
        cells = []
        for key, line in runs.items():
            here = told(metric, gap(metric, reference, line).by)
            figures = (published.get(x, math.nan) for x in (first, key))
            paper = told(metric, apart(metric, *figures))
            cells.append(here if paper == ABSENT else f"{here} ({paper})")
        if {*cells} != {ABSENT}:
            columns[metric] = [written(reference, metric), *cells]
    return _of_columns("Distances", "here (paper)", [reference, *runs.values()], columns)


def _scenes(metrics: Sequence[str], lines: TableLines) -> Table:
    """Means over seeds, one line per scene and line."""
    shown = [
        Repeated(f"{scene}: {line.label}", line.by_scene[scene])
        for scene in sorted({scene for line in lines for scene in line.by_scene})
        for line in lines
        if scene in line.by_scene
    ]
    columns = {metric: [written(each, metric) for each in shown] for metric in metrics}
    return _of_columns("Each scene", "measured", shown, columns)


def _of_columns(
    title: str, head: str, lines: TableLines, columns: Mapping[str, Sequence[str | None]]
) -> Table:
    """A table of `lines`, labelled and with their gaps, and the cells of `columns` by metric."""
    of_table = {head: [": ".join((line.label, *line.gaps)) for line in lines]}
    for metric, column in columns.items():
        of_table[shown_as(metric).heading] = [cell or ABSENT for cell in column]
    return line_table(title, of_table, lines)

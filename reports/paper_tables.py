"""Tables that experiments declare: measured figures, and distances beside the paper's own."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from reports.claims import Claim, Comparison, apart, compare, gap, told
from reports.comparison import COMMON, conditions, marked, shown_as, written
from reports.runs import Repeated, Run, missing_figures
from reports.tables import ABSENT, Table

METHOD = "method"  # the setting of a line that is another method

CURVES = "curves"  # the block of the points of curves over the training
SHARES = (0.25, 0.5)
"""The shares of the training that curves show besides the end."""


class Place(NamedTuple):
    """Where a line is: the name of its table, the data set of its block or CURVES, its key."""

    table: str
    block: str
    line: str


Measured = Mapping[Place, Repeated]
"""What was measured of each line that was planned."""


def point(line: str, share: float) -> str:
    """The key, among CURVES, of a line after this share of its training."""
    return f"{line} after {share}"


@dataclass(frozen=True)
class Line:
    """A line of a table: `job` has its settings, beside those of all lines; the paper's figures.

    Without a `method` it is one of the experiment's method, which is measured with every seed; so
    are others with `every_seed`. Units are bytes, ms and dB, as in our rows. Claims have the words
    that it is `called`, by default the label. An `added` line is none of those declared.
    """

    label: str
    job: Mapping[str, str]
    published: Mapping[str, float] = field(default_factory=dict)
    every_seed: bool = False
    called: str = ""
    added: bool = False


@dataclass(frozen=True)
class Block:
    """The `lines` of a table by key, with the paper's figures on a `data_set`, "" if it has none.

    `published_on` has scenes, size and machine of these figures.
    """

    lines: Mapping[str, Line]
    data_set: str = ""
    published_on: str = ""


@dataclass(frozen=True)
class PaperTable:
    """A table, measured by the experiment `name`; `metrics` are its columns.

    It has a `number` in the paper, or is one of ours. The first of `blocks` has all lines. `notes`
    are what a reader should know before comparing, `claims` what the paper concludes; in what a
    claim says, {KEY} is what this line is called. Distances are those to the line `reference`, by
    default the first. For a line that was not measured stands the one that `instead` has for it.
    The metrics `scenes` are also shown for every scene of a data set. Where a table compares times,
    its lines are measured `in_turns`, frame by frame. With `curve`, the lines of the first block
    are also shown as curves over the training.
    """

    name: str
    title: str
    metrics: Sequence[str]
    blocks: Sequence[Block]
    number: int | None = None
    notes: Sequence[str] = ()
    claims: Sequence[Claim] = ()
    scenes: Sequence[str] = ()
    in_turns: bool = False
    curve: bool = False
    reference: str = ""
    instead: Mapping[str, str] = field(default_factory=dict)

    @property
    def called(self) -> str:
        """What the paper calls it, "Table 3"; of another table, the title."""
        return self.title if self.number is None else f"Table {self.number}"

    @property
    def lines(self) -> Mapping[str, Line]:
        """All lines, by key."""
        return self.blocks[0].lines

    def measured(self, key: str, known: Measured) -> Repeated | None:
        """What was measured of a line of the first block; None if it was not planned."""
        return known.get(Place(self.name, self.blocks[0].data_set, key))

    def shown(self, measured: Measured) -> list[Shown]:
        """The first block, and those further ones of which any line is in `measured`."""
        first, *further = self.blocks
        there = {(place.table, place.block) for place in measured}
        asked = [block for block in further if (self.name, block.data_set) in there]
        return [
            self._shown(first, "", self.notes, measured),
            *(self._shown(block, block.data_set, (), measured) for block in asked),
        ]

    def _shown(self, block: Block, title: str, notes: Sequence[str], measured: Measured) -> Shown:
        """With the line that `instead` has for one that was not measured, and a note about it."""
        lines = {}
        for key, line in block.lines.items():
            place = Place(self.name, block.data_set, key)
            lines[key] = line, measured.get(place, Repeated(line.label, ()))
        called = {key: line.called or line.label for key, line in self.lines.items()}
        there = {key for key, (_, found) in lines.items() if found.runs}
        notes, standing = list(notes), {}
        for missing, other in self.instead.items():
            if missing in lines.keys() - there and other in there:
                line, found = lines.pop(missing)
                stand_in, runs = lines[other]
                lines[other] = replace(stand_in, published=line.published), runs
                standing[missing], called[missing] = other, called[other]
                why = ": ".join(found.gaps) or "not measured"
                if not title:
                    notes.append(f'"{stand_in.label}" stands for "{line.label}" ({why}).')
        claims = [
            replace(
                claim,
                lines=[standing.get(key, key) for key in claim.lines],
                says=claim.says.format_map(called),
            )
            for claim in self.claims
        ]
        return Shown(self, title, block.published_on, lines, notes, claims)


@dataclass(frozen=True)
class Shown:
    """What a page shows of a block: each line with what was measured, by key.

    The first block of a table has no `title`, further ones that of their data set.
    """

    table: PaperTable
    title: str
    published_on: str
    lines: Mapping[str, tuple[Line, Repeated]]
    notes: Sequence[str]
    claims: Sequence[Claim]


def comparisons(table: PaperTable, measured: Measured) -> list[Comparison]:
    """What the paper concludes from a table, compared with what was measured here."""
    found = []
    for block in table.shown(measured):
        known = {key: runs for key, (_, runs) in block.lines.items()}
        for claim in block.claims:
            figures = {
                key: line.published[claim.metric]
                for key, (line, _) in block.lines.items()
                if claim.metric in line.published
            }
            found += [
                replace(each, table=table.called, data_set=block.title)
                for each in compare(claim, known, figures)
            ]
    return found


def measured_where(runs: Sequence[Run]) -> dict[str, str]:
    """Under which conditions, and on which machines, `runs` were measured."""
    machines = (run.record["machine"] for run in runs)
    named = dict.fromkeys(f"{each['cpu']} with {each['threads']} threads" for each in machines)
    return {**conditions(runs, (*COMMON, "seed", "commit")), "machine": " / ".join(named)}


def section(table: PaperTable, measured: Measured, said: Collection[str] = ()) -> list[str | Table]:
    """A table as parts of a page: the lines of its blocks, and those of each scene.

    The page has `said` some of where they were measured already.
    """
    heading = table.title if table.number is None else f"{table.called}: {table.title}"
    parts: list[str | Table] = []
    for block in table.shown(measured):
        parts.append(f"### {block.title}" if block.title else f"## {heading}")
        parts += _block(block, said)
    own = [line for key in table.lines if (line := table.measured(key, measured))]
    if table.scenes and len({scene for line in own for scene in line.by_scene}) > 1:
        parts += ["### Each scene", _scenes(table.scenes, own)]
    return parts


def _block(block: Shown, said: Collection[str]) -> list[str | Table]:
    """What was measured, under which conditions; distances, here and in the paper; notes.

    All figures are shown where lines are methods, or where there are no distances.
    """
    runs = [run for _, line in block.lines.values() for run in line.runs]
    facts = {name: value for name, value in measured_where(runs).items() if name not in said}
    where = ", ".join(map(" ".join, facts.items())) if runs else ""
    published = any(line.published for line, _ in block.lines.values())
    parts: list[str | Table] = [where and f"Measured: {where}."]
    if not published or any(METHOD in line.job for line, _ in block.lines.values()):
        parts.append(figure_table(block))
    if published:
        parts += [f"Paper: {block.published_on}.", distance_table(block)]
    notes = dict.fromkeys((*block.notes, *missing_figures(runs)))
    return [part for part in (*parts, "\n".join(f"- {note}" for note in notes)) if part]


def figure_table(block: Shown) -> Table:
    """A table of measured figures.

    Among measured figures under the same conditions, the best of a column is bold and, of at least
    three, the second best is italic.
    """
    lines = [line for _, line in block.lines.values()]
    columns = {x: marked(lines, x, ("**%s**", "*%s*")) for x in block.table.metrics}
    return _of_columns(block.title or block.table.title, "measured", lines, columns)


def distance_table(block: Shown) -> Table:
    """The figures of the table's reference, then how far each line is from it, here and in the
    paper, by metric."""
    lines = dict(block.lines)
    key = block.table.reference
    published, reference = lines.pop(key if key in lines else next(iter(lines)))

    def cell(line: Line, runs: Repeated, metric: str) -> str:
        here = told(metric, gap(metric, reference, runs).by)
        figures = (each.published.get(metric, math.nan) for each in (published, line))
        paper = told(metric, apart(metric, *figures))
        return here if paper == ABSENT else f"{here} ({paper})"

    columns = {
        metric: [written(reference, metric), *distances]
        for metric in block.table.metrics
        if {*(distances := [cell(*line, metric) for line in lines.values()])} != {ABSENT}
    }
    every = [reference, *(runs for _, runs in lines.values())]
    return _of_columns("Distances", "here (paper)", every, columns)


def _scenes(metrics: Sequence[str], lines: Sequence[Repeated]) -> Table:
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
    title: str, head: str, lines: Sequence[Repeated], columns: Mapping[str, Sequence[str | None]]
) -> Table:
    """A table of `lines`, labelled and with their gaps, and the cells of `columns` by metric."""
    names = (": ".join((line.label, *line.gaps)) for line in lines)
    cells = ([cell or ABSENT for cell in column] for column in columns.values())
    heads = (head, *(shown_as(metric).heading for metric in columns))
    rows = tuple(zip(names, *cells, strict=True))
    return Table(title, heads, rows, sources=tuple(line.keys for line in lines))

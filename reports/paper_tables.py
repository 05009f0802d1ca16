"""The paper's tables, as experiments declare them: measured figures, distances beside its own."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from reports.claims import Claim, Comparison, apart, compare, gap, told
from reports.comparison import COMMON, marked, metric_format, written
from reports.outliers import REFERENCES
from reports.runs import Repeated, Run, missing_figures
from reports.tables import ABSENT, Table

METHOD = "method"
AFTER, SHARES = "method.after", (0.25, 0.5)
"""The setting for the share of the training after which a method is rendered, and the shares that
curves show besides the end."""
OF_CURVES = {"protocol.name": "psnr", "protocol.lpips": "[]"}
"""Curves need only PSNR; LPIPS would take most of a frame's time."""

DATA_SETS: Any = OmegaConf.to_container(OmegaConf.load(REFERENCES))["data_sets"]  # type: ignore[index,call-overload]
FIRST = next(iter(DATA_SETS))
"""The paper's data sets by name; scenes that none of them names are compared with the first."""

Lines = Mapping[str, Sequence[Repeated]]
"""The measured lines of each table, by table name."""


@dataclass(frozen=True)
class Line:
    """A line of a table: `job` has its settings, beside those of all lines; the paper's figures.

    Without a `method` it is one of the paper's method, which is measured with every seed; so are
    others with `every_seed`. Units are bytes, ms and dB, as in our rows.
    """

    label: str
    job: Mapping[str, str]
    published: Mapping[str, float] = field(default_factory=dict)
    every_seed: bool = False


@dataclass(frozen=True)
class PaperTable:
    """A table of the paper, measured by the experiment `name`; `metrics` are its columns.

    `published_on` has scenes, size and machine of the paper's figures; they are those of a
    `data_set`, "" for scenes of which the paper has none. `notes` are what a reader should know
    before comparing, `claims` what the paper concludes. For a line that was not measured stands the
    one that `instead` has for its label. Labels end with `mark`, but not in `claims` and `instead`.
    Distances are those to the line `reference`, by default the first. `beside` has the figures of
    further data sets, `beyond` is a method beyond the paper, shown with the same lines as the
    paper's method and notes of its own. The metrics `scenes` are also shown for every scene of a
    data set. Where a table compares times, its lines are measured `in_turns`, frame by frame. With
    `curve`, the lines of the paper's method are also shown as curves over the training.
    """

    name: str
    title: str
    published_on: str
    metrics: Sequence[str]
    lines: Sequence[Line]
    notes: Sequence[str] = ()
    claims: Sequence[Claim] = ()
    beyond: str | None = None
    beyond_notes: Sequence[str] = ()
    scenes: Sequence[str] = ()
    in_turns: bool = False
    curve: bool = False
    reference: str = ""
    instead: Mapping[str, str] = field(default_factory=dict)
    mark: str = ""
    data_set: str = FIRST
    beside: Sequence[PaperTable] = ()

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
        """The table, those of further data sets, then the lines of the method beyond the paper."""
        if self.beyond is None:
            return [self, *self.beside]
        lines = [
            Line(line.label, {**line.job, METHOD: self.beyond})
            for line in self.lines
            if METHOD not in line.job
        ]
        last = self.block(f"Beyond the paper: {self.beyond}", lines, self.beyond)
        return [self, *self.beside, replace(last, notes=self.beyond_notes, claims=())]

    def block(self, title: str, lines: Sequence[Line], mark: str) -> PaperTable:
        """A further block with this title and these `lines`, whose labels then have this mark."""
        mark = f" ({mark})"
        marked_lines = [replace(line, label=f"{line.label}{mark}") for line in lines]
        names = {line.label: new.label for line, new in zip(lines, marked_lines, strict=True)}
        block = replace(self, title=title, lines=marked_lines, notes=(), curve=False, beyond=None)
        return replace(block, reference=names.get(self.reference, ""), beside=(), mark=mark)

    def shown(self, measured: Mapping[str, Repeated]) -> list[PaperTable]:
        """The table, and those further blocks of which any line is in `measured` (by label); in
        each, what stands for a line has its published figures."""
        first, *further = self.blocks
        there = (x for x in further if any(line.label in measured for line in x.lines))
        return [block._with_stand_ins(measured) for block in (first, *there)]

    def _with_stand_ins(self, measured: Mapping[str, Repeated]) -> PaperTable:
        """With the line that `instead` has for one that was not measured, and a note about it."""
        lines = {line.label.removesuffix(self.mark): line for line in self.lines}
        known = dict(zip(lines, self.measured(measured), strict=True))
        there = {label for label, line in known.items() if line.runs}
        notes, standing = list(self.notes), {}
        for missing, other in self.instead.items():
            if missing in known.keys() - there and other in there:
                published = lines.pop(missing).published
                lines[other] = replace(lines[other], published=published)
                standing[missing] = other
                why = ": ".join(known[missing].gaps) or "not measured"
                notes += [] if self.mark else [f'"{other}" stands for "{missing}" ({why}).']
        claims = [replace(x, lines=[standing.get(y, y) for y in x.lines]) for x in self.claims]
        for names in standing.items():  # what they differ in, as a claim says it
            words, others = (name.rpartition(", ")[2] for name in names)
            claims = [replace(x, says=x.says.replace(words, others)) for x in claims]
        return replace(self, lines=[*lines.values()], notes=notes, claims=claims)

    def name_of(self, line: Line) -> str:
        """The label of `line` as its block shows it; a method beyond the paper has its own name."""
        method = line.job.get(METHOD, "")
        label = line.label.removesuffix(self.mark)
        return label.replace("SteerNeRF", method) if self.mark == f" ({method})" else label

    def measured(self, known: Mapping[str, Repeated]) -> list[Repeated]:
        """Its lines of `known`, by label; those that are not there have no runs."""
        return [known.get(line.label, Repeated(line.label, ())) for line in self.lines]


def paper_tables(folder: Path, data_sets: Sequence[str] = (FIRST,)) -> list[PaperTable]:
    """The tables that the experiments in `folder` declare, in the paper's order.

    A table has the figures of those of `data_sets` for which the paper has any, the first of them
    in front.
    """
    paths = sorted(folder.glob("table*.yaml"), key=lambda path: (len(path.stem), path.stem))
    return [_table(path, data_sets) for path in paths]


def _table(path: Path, data_sets: Sequence[str]) -> PaperTable:
    """What an experiment declares below `table`; what its lines leave out follows from its grid.

    Without jobs of their own, there is a line for each value of the grid. The method beyond the
    paper is the one that the grid has besides that of the experiment and those that lines name.
    What it declares of the paper is that of each data set by name, or of the first.
    """
    experiment: Any = OmegaConf.to_container(OmegaConf.load(path))
    content = experiment["table"]
    params = experiment["hydra"]["sweeper"]["params"]
    grid = {name: str(values).split(",") for name, values in params.items()}
    _, *further = grid.pop(METHOD, [""])
    declared, label = content.pop("lines"), content.pop("label", "{}")
    content.pop("axis", None)  # for studies
    jobs = [line["job"] for line in declared if "job" in line] or [
        {name: value} for name, values in grid.items() for value in values
    ]
    published_on = _by_data_set(content.pop("published_on"))
    data_set, *others = [name for name in data_sets if name in published_on] or [""]
    lines = []
    for line, job in zip(declared, jobs, strict=True):
        known = _by_data_set(line.get("published", ())).get(data_set, ())
        paper = zip(content["metrics"], known, strict=len(known) > 0)
        figures = {metric: figure for metric, figure in paper if figure is not None}
        if "fps" in figures:
            figures["frame_ms"] = 1000 / figures["fps"]
        name = line.get("label") or label.format(*job.values())
        lines.append(Line(name, job, figures, line.get("every_seed", False)))
    claims = [_claim(**declared) for declared in content.pop("claims")]
    only = content.pop("beside", [line.label for line in lines])
    named = {job.get(METHOD) for job in jobs}
    beyond = next((method for method in further if method not in named), None)
    where = published_on.get(data_set, "")
    table = PaperTable(path.stem, published_on=where, lines=lines, claims=claims, **content)
    halves = [(name, _table(path, [name])) for name in others]
    beside = [half.block(x, [y for y in half.lines if y.label in only], x) for x, half in halves]
    return replace(table, data_set=data_set, beyond=beyond, beside=beside)


def _claim(**declared: Any) -> Claim:
    """A claim about lines that an experiment declares as `rising` or as `alike`."""
    alike = "alike" in declared
    return Claim(lines=declared.pop("alike" if alike else "rising"), alike=alike, **declared)


def _by_data_set(declared: Any) -> Mapping[str, Any]:
    return declared if isinstance(declared, dict) else {FIRST: declared}


def comparisons(table: PaperTable, lines: Sequence[Repeated]) -> list[Comparison]:
    """What the paper concludes from a table, compared with what was measured here."""
    measured = {line.label: line for line in lines}
    found = []
    for block in table.shown(measured):
        where = f"{table.number}, {block.title}" if block.mark else table.number
        own = {line.label.removesuffix(block.mark): line for line in block.lines}
        known = dict(zip(own, block.measured(measured), strict=True))
        for claim in block.claims:
            paper = ((label, line.published.get(claim.metric)) for label, line in own.items())
            figures = {label: figure for label, figure in paper if figure is not None}
            found += [replace(x, table=where) for x in compare(claim, known, figures)]
    return found


def conditions(runs: Sequence[Run]) -> dict[str, str]:
    """Under which conditions, and where, `runs` were measured: by fact, all values of it."""
    facts = {name: [str(run.facts[name]) for run in runs] for name in (*COMMON, "seed", "commit")}
    machines = [run.record["machine"] for run in runs]
    facts["machine"] = [f"{each['cpu']} with {each['threads']} threads" for each in machines]
    return {name: " / ".join(dict.fromkeys(values)) for name, values in facts.items()}


def section(
    table: PaperTable, lines: Sequence[Repeated], said: Collection[str] = ()
) -> list[str | Table]:
    """A table as parts of a page: the paper's lines, those of other blocks, each scene.

    The page has `said` some of the `conditions` already.
    """
    measured = {line.label: line for line in lines}
    parts: list[str | Table] = []
    for block in table.shown(measured):
        parts.append(f"### {block.title}" if block.mark else f"## {table.number}: {table.title}")
        parts += _block(block, measured, said)
    elsewhere = {line.label for block in table.beside for line in block.lines}
    own = [line for line in lines if line.label not in elsewhere]
    if table.scenes and len({scene for line in own for scene in line.by_scene}) > 1:
        parts += ["### Each scene", _scenes(table.scenes, own)]
    return parts


def _block(
    table: PaperTable, measured: Mapping[str, Repeated], said: Collection[str]
) -> list[str | Table]:
    """What was measured, under which conditions; distances, here and in the paper; notes.

    All figures are shown where lines are methods, or where there are no distances.
    """
    runs = [run for line in table.measured(measured) for run in line.runs]
    facts = {name: value for name, value in conditions(runs).items() if name not in said}
    where = ", ".join(f"{name} {value}" for name, value in facts.items()) if runs else ""
    published = any(line.published for line in table.lines)
    parts: list[str | Table] = [where and f"Measured: {where}."]
    if not published or any(METHOD in line.job for line in table.lines):
        parts.append(figure_table(table, measured))
    if published:
        parts += [f"Paper: {table.published_on}.", distance_table(table, measured)]
    notes = dict.fromkeys((*table.notes, *missing_figures(runs)))
    return [part for part in (*parts, "\n".join(f"- {note}" for note in notes)) if part]


def figure_table(table: PaperTable, measured: Mapping[str, Repeated]) -> Table:
    """A table of measured figures (lines by label), without the mark of its block.

    Among measured figures under the same conditions, the best of a column is bold and, of at least
    three, the second best is italic.
    """
    lines = table.measured(measured)
    columns = [
        [text or ABSENT for text in marked(lines, metric, ("**%s**", "*%s*"))]
        for metric in table.metrics
    ]
    names = [
        ": ".join((table.name_of(each), *line.gaps))
        for each, line in zip(table.lines, lines, strict=True)
    ]
    heads = ("measured", *(metric_format(metric)[0] for metric in table.metrics))
    cells = tuple(zip(names, *columns, strict=True))
    return Table(table.title, heads, cells, sources=tuple(line.keys for line in lines))


def distance_table(table: PaperTable, measured: Mapping[str, Repeated]) -> Table:
    """The figures of the table's reference, then how far each line is from it, here and in the
    paper, by metric."""
    known = {line.label: line for line in table.lines}
    reference = known[table.reference or table.lines[0].label]
    others = [line for line in table.lines if line is not reference]
    runs = dict(zip(known, table.measured(measured), strict=True))

    def cell(line: Line, metric: str) -> str:
        here = gap(metric, runs[reference.label], runs[line.label])
        figures = (each.published.get(metric, math.nan) for each in (reference, line))
        texts = told(metric, here.by), told(metric, apart(metric, *figures))
        return "{} ({})".format(*texts).removesuffix(f" ({ABSENT})")

    columns = {metric: [cell(line, metric) for line in others] for metric in table.metrics}
    columns = {
        metric: [written(runs[reference.label], metric) or ABSENT, *cells]
        for metric, cells in columns.items()
        if {*cells} != {ABSENT}
    }
    heads = ("here (paper)", *(metric_format(metric)[0] for metric in columns))
    lines = reference, *others
    names = [": ".join((table.name_of(line), *runs[line.label].gaps)) for line in lines]
    cells = tuple(zip(names, *columns.values(), strict=True))
    return Table("Distances", heads, cells, sources=tuple(runs[x.label].keys for x in lines))


def _scenes(metrics: Sequence[str], lines: Sequence[Repeated]) -> Table:
    """Means over seeds, one line per scene and line."""
    shown = [
        Repeated(f"{scene}: {line.label}", line.by_scene[scene])
        for scene in sorted({scene for line in lines for scene in line.by_scene})
        for line in lines
        if scene in line.by_scene
    ]
    cells = tuple(
        (each.label, *(written(each, metric) or ABSENT for metric in metrics)) for each in shown
    )
    heads = ("measured", *(metric_format(metric)[0] for metric in metrics))
    return Table("Each scene", heads, cells, sources=tuple(each.keys for each in shown))

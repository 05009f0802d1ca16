"""Writes the page about the paper's tables: measured and published figures, trends, pictures.

Its texts, and which lines its plots and images show, are in `paper/page.yaml`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from reports import figures
from reports.claims import NOT_MEASURED, claim_table, finding_table
from reports.images import Parts, Picture, frame_section, kept_frames
from reports.paper_tables import Measured, PaperTable, comparisons, measured_where, section
from reports.publish import publish
from reports.runs import Repeated, Run, Runs, TableLines, listed

PAGE: Any = OmegaConf.to_container(OmegaConf.load(Path(__file__).parent / "paper" / "page.yaml"))


def write_paper_page(
    tables: Sequence[PaperTable], measured: Measured, folder: Path, missing: Mapping[str, str] = {}
) -> Path:
    """Write `folder/report.md` with its pictures, and the same as `report.html`; return the former.

    The page shows `tables` in this order, with what was `measured`; `missing` says why scenes are
    left out, by name. Raises SteerbenchError if `folder` cannot be written to.
    """
    runs = list({run.key: run for line in measured.values() for run in line.measured}.values())
    return publish([*_parts(tables, measured, runs, missing)], folder, runs)


def _parts(
    tables: Sequence[PaperTable],
    measured: Measured,
    runs: Runs,
    missing: Mapping[str, str],
) -> Parts:
    shown = PAGE if any(table.number is not None for table in tables) else _of_own(tables)
    yield f"# {shown['title']}"
    compared = [each for table in tables for each in comparisons(table, measured)]
    concluded = any(each.here is not NOT_MEASURED for each in compared)
    if concluded:
        sampled = sum(each.here.proves and each.here.half > 0 for each in compared)
        yield f"## {PAGE['conclusions']}"
        yield finding_table(compared)
        yield PAGE["verdicts"].format(sampled=sampled, count=len(compared)).strip()
    if missing:
        yield "## Scenes that are left out"
        yield "\n".join(f"- missing: {name}: {why}" for name, why in missing.items())
    yield "## The tables"
    if any(line.published for table in tables for line in table.lines.values()):
        yield PAGE["distances"].strip()
    yield PAGE["reading"].strip()
    facts = measured_where(runs).items() if runs else ()
    said = {name: value for name, value in facts if " / " not in value}  # once for all tables
    if said:
        yield f"Measured: {listed(said)}."
    for table in tables:
        yield from section(table, measured, said)
    for plot in shown["plots"]:
        yield from _plot(plot, _chosen(plot["lines"], tables, measured))
    for images in shown["images"]:
        yield from _images(images["title"], _chosen(images["lines"], tables, measured))
    if concluded:
        yield f"## {PAGE['comparisons']}"
        yield claim_table(compared)
    sources = "\n".join(f"{run.key}  {run.record['command']}" for run in runs)
    yield f"## Runs\n\nTheir keys in the store, and the commands:\n\n```\n{sources}\n```"


def _of_own(tables: Sequence[PaperTable]) -> Mapping[str, Any]:
    """Title, plots and images of all lines, for tables that are not the paper's."""
    every = ((table.name, key, line) for table in tables for key, line in table.lines.items())
    lines = {line.label: (name, key) for name, key, line in every}
    return {
        "title": ", ".join(table.title for table in tables),
        "plots": [{**plot, "lines": lines} for plot in PAGE["plots"] if "metric" in plot],
        "images": [{"title": "Pictures", "lines": lines}],
    }


def _plot(plot: Mapping[str, Any], lines: TableLines) -> Parts:
    """A plot of `lines` with heading and caption, if any was measured."""
    if "metric" in plot:
        drawn = figures.quality_plot(lines, plot["metric"])
    else:
        runs = _first_runs(lines, one_scene=plot.get("one_scene", False))
        draw = partial(getattr(figures, plot["draw"]), runs)
        drawn = Picture(plot["file"], plot["title"], draw)
    if lines and (drawn.marks or "draw" in plot):
        yield f"## {plot['title']}"
        yield drawn
        yield plot["caption"].strip()


def _images(title: str, lines: TableLines) -> Parts:
    runs = _first_runs(lines, one_scene=True)
    runs = [run for run in runs if run.views == runs[0].views]
    if runs and (frames := kept_frames(runs)):
        yield f"## {title}\n\nA frame that all runs kept."
        yield from frame_section(runs, frames[len(frames) // 2], f"frames-{title.lower()}")


def _chosen(
    wanted: Mapping[str, Sequence[Any]], tables: Sequence[PaperTable], measured: Measured
) -> list[Repeated]:
    """The measured lines in `wanted`: by their label here, a table and a key; for one that was not
    measured, the one that stands for it. After them, the lines added to these tables."""
    named = {name for name, _ in wanted.values()}
    known = {table.name: table for table in tables if table.name in named}
    every = ((name, key, line) for name, of in known.items() for key, line in of.lines.items())
    added = {line.label: (name, key) for name, key, line in every if line.added}
    chosen = []
    for label, (name, key) in {**wanted, **added}.items():
        if table := known.get(name):
            keys = filter(None, (str(key), table.instead.get(str(key))))
            lines = [table.measured(each, measured) for each in keys]
            chosen += [replace(line, label=label) for line in lines if line and line.runs][:1]
    return chosen


def _first_runs(lines: TableLines, one_scene: bool) -> list[Run]:
    """The first run of each line: the mean over all scenes, or that of the first scene."""
    runs = ((line.label, (line.measured if one_scene else line.runs)[0]) for line in lines)
    return [replace(run, label=label) for label, run in runs]

"""Writes a page about measured runs: one table of all, pictures, provenance of every figure."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from bench.results import Store
from reports import figures
from reports.comparison import comparison, conditions_of
from reports.images import MOST_RENDERINGS, Part, Picture, frame_section, kept_frames
from reports.publish import publish
from reports.runs import Repeated, Run, load_runs, missing_figures, over_common_frames
from reports.tables import Table, run_tables


def write_page(
    store: Store, labels: Mapping[str, str], folder: Path, failures: Mapping[str, str] = {}
) -> Path:
    """Write `folder/report.md` with its pictures, and the same as `report.html`; return the former.

    The page replaces an earlier one only once it is complete. `labels` has the names of the runs on
    the page, by key and in its order; `failures` says why a run is missing, by its label. Raises
    SteerbenchError if a run is not in the store or `folder` cannot be written to.
    """
    runs = over_common_frames(load_runs(store, labels))
    parts = [
        *_heading(runs, failures),
        *_tradeoffs(runs),
        "## Where the time goes",
        Picture("stages", "Mean ms of a frame by stages", partial(figures.stage_bars, runs)),
        "One bar per run: the mean time of a frame, divided into the stages of the method; a stage"
        " includes the stages inside it. Time outside all stages is `other`.",
        *_pictures(runs),
        *(part for run in runs for part in _figures(run)),
        *_provenance(runs),
    ]
    return publish(parts, folder, runs)


def _heading(runs: Sequence[Run], failures: Mapping[str, str]) -> Iterator[Part]:
    """Title, the table of all runs, and how to read it."""
    few = len(runs) <= MOST_RENDERINGS
    labels = ", ".join(run.label for run in runs) if few else f"{len(runs)} runs"
    scenes = ", ".join(dict.fromkeys(run.facts["scene"] for run in runs))
    table = comparison(runs, failures)
    scored, timed = (
        " / ".join(dict.fromkeys(str(run.headline["n"][metric]) for run in runs))
        for metric in ("psnr", "frame_ms")
    )
    reading = f"Arrows point to better. Quality is a mean over {scored} frames, time over {timed}."
    if table.bold:
        reading += (
            " The best figure of each column is **bold**, among runs with the same frames, protocol"
            " and machine."
        )
    yield f"# {labels} on {scenes}"
    yield f"Measured: {conditions_of(runs)}."
    yield table
    yield reading
    yield from missing_figures(runs)


def _tradeoffs(runs: Sequence[Run]) -> Iterator[Part]:
    """Plots of quality against its costs, if there are runs to compare."""
    lines = [Repeated(run.label, [run]) for run in runs]
    for title, metric, better in (
        ("Quality against time", "frame_ms", "faster"),
        ("Quality against memory", "size_bytes.total", "smaller"),
    ):
        plot = figures.quality_plot(lines, metric)
        if len(plot.marks) > 1:
            yield f"## {title}"
            yield plot
            yield f"One mark a run: further up is better, further left is {better}."


def _pictures(runs: Sequence[Run]) -> Iterator[Part]:
    """Images of the kept frames; runs that rendered the same frames share images."""
    groups: dict[tuple[object, ...], list[Run]] = {}
    for run in runs:
        groups.setdefault(run.views, []).append(run)
    parts = [
        part
        for number, group in enumerate(groups.values(), 1)
        for frame in kept_frames(group)
        for part in frame_section(group, frame, f"frames-{number}")
    ]
    yield from ("## Pictures", *(parts or ["No picture was kept."]))


def _figures(run: Run) -> Iterator[Part]:
    yield f"## {run.label}, run {run.key}"
    for table in run_tables(run.rows):
        yield f"### {table.title}"
        yield replace(table, sources=((run.key,),) * len(table.lines))


def _provenance(runs: Sequence[Run]) -> Iterator[Part]:
    """The commands, then facts: one line if all runs share it, otherwise one line per run."""
    commands = "\n".join(dict.fromkeys(run.record["command"] for run in runs))
    lines = []
    for name in runs[0].provenance:
        values = [run.provenance[name] for run in runs]
        if len(set(values)) == 1:
            lines.append((name, values[0]))
        else:
            names = (f"{name}, {run.label}" for run in runs)
            lines += zip(names, values, strict=True)
    yield "## Provenance\n\nEvery figure and picture on this page was made by"
    yield f"```sh\n{commands}\n```"
    yield Table("Provenance", ("", ""), tuple(lines))

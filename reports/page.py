"""Writes a page about measured runs: one table of all, pictures, provenance of every figure."""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

from bench.results import Store
from reports import figures
from reports.comparison import comparison, conditions_of, machines
from reports.images import MOST_RENDERINGS, Parts, Picture, frame_section, kept_frames
from reports.lines import Lines, as_lines
from reports.publish import publish
from reports.runs import Run, Runs, grouped, joined, load_runs, missing_figures
from reports.tables import Table, run_tables


def write_page(
    store: Store, keys: Iterable[str], folder: Path, failures: Mapping[str, str] = {}
) -> Path:
    """Write `folder/report.md` with its pictures, and the same as `report.html`; return the former.

    The page replaces an earlier one only once it is complete. It shows the runs with these `keys`,
    in this order; `failures` says why others are missing, by their label. Raises SteerbenchError if
    a run is not in the store or `folder` cannot be written to.
    """
    lines = as_lines(load_runs(store, keys))
    runs = lines.runs
    few = len(runs) <= MOST_RENDERINGS
    several = any(len(line.runs) > 1 for line in lines.lines)
    named = [
        replace(run, label=line.label + f", seed {run.facts['seed']}" * several)
        for line in lines.lines
        for run in line.runs
    ]
    parts = [
        *_heading(lines, failures),
        *_ablations(lines),
        *_tradeoffs(lines),
        "## Where the time goes",
        Picture("stages", "Mean ms of a frame by stages", partial(figures.stage_bars, lines.lines)),
        "One bar per line: the mean time of a frame, divided into the stages of the method; a stage"
        " includes the stages inside it. Time outside all stages is `other`.",
        *_pictures([replace(line.runs[0], label=line.label) for line in lines.lines]),
        *(part for run in runs if few for part in _figures(run)),
        *_provenance(named),
    ]
    return publish(parts, folder, runs)


def _heading(lines: Lines, failures: Mapping[str, str]) -> Parts:
    """Title, the table of all lines, and how to read it."""
    runs, (methods, *varied) = lines.runs, lines.settings
    labels = ", ".join(dict.fromkeys(lines.settings[methods]))
    scenes = ", ".join(dict.fromkeys(run.facts["scene"] for run in runs))
    first, *further = comparison(lines, failures)
    scored, timed = (
        joined(run.headline["n"][metric] for run in runs) for metric in ("psnr", "frame_ms")
    )
    reading = f"Arrows point to better. Quality is a mean over {scored} frames, time over {timed}."
    seeds = {len(line.runs) for line in lines.lines}
    if max(seeds) > 1:
        reading += " Figures are means over seeds, ± half their 95 % interval (t-distribution)."
    if 2 in seeds:
        reading += " With two seeds it is 12.7 standard errors: use three or more."
    if "frames" in first.columns:
        reading += (
            " Lines of cold frames, for which the path is too short, are not ranked with others:"
            " choose more frames (`budget.frames`), or a path without cuts (`trajectory=orbit`)."
        )
    if any(cell.startswith("**") for line in first.lines for cell in line):
        reading += (
            " The best figure of each column is **bold**, with those from which the interval of its"
            " difference, seed by seed, does not tell it, among lines with the same frames,"
            " protocol and machine."
        )
    days = sorted(str(datetime.fromtimestamp(run.record["stored"], UTC).date()) for run in runs)
    when = " to ".join(dict.fromkeys((days[0], days[-1])))
    yield f"# {': '.join(filter(None, (labels, ', '.join(varied))))} on {scenes}"
    yield f"Measured {when} on {machines(runs)}: {conditions_of(runs, varied)}."
    yield first
    yield reading
    for table in further:
        yield f"{table.title}:"
        yield table
    yield from missing_figures(runs)


def _tradeoffs(lines: Lines) -> Parts:
    """Plots of quality against its costs, if there are lines to compare."""
    for title, metric, better in (
        ("Quality against time", "frame_ms", "faster"),
        ("Quality against memory", "size_bytes.total", "smaller"),
    ):
        plot = figures.quality_plot(lines.lines, metric, lines.settings)
        if len(plot.marks) > 1:
            yield f"## {title}"
            yield plot
            yield (
                f"One mark a line, bars are intervals; further up is better, further left is"
                f" {better}. The axis across is logarithmic."
            )


def _ablations(lines: Lines) -> Parts:
    """Plots of quality over the settings with several numbers."""
    scored = lines.frame(["psnr"]).dropna(subset=["psnr"])
    for name in lines.settings:
        if scored[name].map(figures.as_number).nunique() > 2:
            shows = f"PSNR in dB over {name}"
            yield f"## Quality over {name}"
            yield Picture(f"psnr-{name}", shows, partial(figures.quality_along, lines, name))
            yield "Bars are intervals over seeds; dashed: what has no such setting."


def _pictures(runs: Runs) -> Parts:
    """Images of the kept frames; runs that rendered the same frames share images."""
    groups = grouped(runs, lambda run: run.views).values()
    parts = [
        part
        for number, group in enumerate(groups, 1)
        for frame in kept_frames(group)
        for part in frame_section(group, frame, f"frames-{number}")
    ]
    yield from ("## Pictures", *(parts or ["No picture was kept."]))


def _figures(run: Run) -> Parts:
    yield f"## {run.label}, run {run.key}"
    for table in run_tables(run.rows):
        yield f"### {table.title}"
        yield replace(table, sources=[[run.key]] * len(table.lines))


def _provenance(runs: Runs) -> Parts:
    """The commands, then facts: one line if all runs share it, otherwise one line per run."""
    commands = "\n".join(dict.fromkeys(run.command for run in runs))
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
    yield Table("Provenance", ("", ""), lines)

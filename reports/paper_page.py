"""The page about the tables of the paper: figures beside the published ones, trends, pictures."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from bench.errors import explained
from reports import doubts, figures
from reports.doubts import Doubt
from reports.pictures import beside, shown_frames
from reports.publish import add_picture, publish
from reports.published import PaperTable, section
from reports.runs import Run
from reports.seeds import Repeated

Lines = Mapping[str, Sequence[Repeated]]
"""What there is of the lines of each table, by the name of the table."""

METHODS = {
    ("table1", "Instant-NGP"): "Instant-NGP",
    ("table1", "SteerNeRF, the paper's, fp32"): "SteerNeRF, the paper's",
    ("table1", "SteerNeRF, ours, fp32"): "SteerNeRF, ours",
}
"""Table and line of what is shown in pictures, and what it is called there."""

ABLATION = {
    ("table5", "without joint training"): "without joint training",
    ("table4", "K = 3"): "K = 3",
    ("table4", "K = 6"): "ours: joint training, K = 6",
}
"""The same of the figure of the paper's ablations."""

RANGE = {
    ("table2", "without range reduction"): "ours, without range reduction",
    ("table2", "with range reduction, by window"): "ours, with range reduction",
}


def write_paper_page(
    tables: Sequence[PaperTable], lines: Lines, found: Sequence[Doubt], folder: Path
) -> Path:
    """Write `folder/report.md` with its pictures, and the same as `report.html`; return the former.

    Args:
        found: of these runs or of others.

    Raises:
        SteerbenchError: `folder` cannot be written to.
    """
    with explained(folder):
        parts = [
            "# The tables of SteerNeRF, measured",
            READING,
            *_doubted(lines, found),
            *(section(table, lines.get(table.name, ())) for table in tables),
            *_plots(lines, folder),
            *_compared("Methods", METHODS, lines, folder),
            *_compared("Ablations", ABLATION, lines, folder),
            _sources(lines),
        ]
    return publish("\n\n".join(parts), folder)


READING = """\
A cell is what was measured / what the paper has / the difference. The two were measured on
different scenes, machines and trainings, which stand above each table: what can be compared is how
the lines differ. With several seeds a measured figure is their mean ± half of its 95 % interval.
The best figure of a column is **bold**, the second of three or more *italic*, among those of the
same frames, protocol and machine; LPIPS columns name the network of the measured figure. A `–` is
a figure that the paper does not give, or a method that does not exist here. Figures are means over
steady frames; cold ones, before which too few were rendered, are left out.

The method `steernerf_paper` follows the paper's pipeline; `steernerf` is our own, which Tables 2
to 6 vary.

Below each table stands what grows from line to line in the paper, and by how much it grows here,
over the frames that both lines have. With several seeds it `holds` where the whole 95 % interval
is above zero. The interval of a single seed is one over frames: it knows nothing of the difference
between one training and the next, nor of how fast the machine was when a line was measured, and so
proves nothing."""


def _doubted(lines: Lines, found: Sequence[Doubt]) -> Iterator[str]:
    listed = doubts.table(found, _runs(lines))
    if listed.lines:
        yield f"## {listed.title}\n\n{listed.markdown()}"


def _runs(lines: Lines) -> list[Run]:
    """Every run of the page, once."""
    runs = (run for table in lines.values() for line in table for run in line.runs)
    return list({run.key: run for run in runs}.values())


def _plots(lines: Lines, folder: Path) -> Iterator[str]:
    first = [line for line in lines.get("table1", ()) if line.runs]
    if first:
        draw = partial(figures.quality_against, first, "frame_ms", 1.0, "ms a frame")
        yield _figure(
            "Quality against time",
            add_picture(folder, "psnr-ms", draw),
            "PSNR against the mean time of a frame, one mark a measured line of Table 1: further"
            " up is better, further left is faster. Time has a logarithmic scale.",
        )
    lengths = [line for line in lines.get("table6", ()) if line.runs]
    sized = [*first, *(replace(line, label=f"ours, {line.label}") for line in lengths)]
    if sized:
        draw = partial(figures.quality_against, sized, "size_bytes.total", 1e6, "MB of the model")
        yield _figure(
            "Quality against memory",
            add_picture(folder, "psnr-bytes", draw),
            "PSNR against the size of the model, one mark a measured line of Tables 1 and 6, the"
            " latter with another length T of the hash table: further up is better, further left is"
            " smaller. Size has a logarithmic scale.",
        )
    if divided := _named(METHODS | RANGE, lines):
        yield _figure(
            "Where the time goes",
            add_picture(folder, "stages", partial(figures.stage_bars, divided)),
            "The mean time of a frame, one bar for each run, divided into the stages of its method."
            " Rays, march, field and composite of Instant-NGP are what SteerNeRF does at low"
            " resolution in `field`, at full resolution in `refinement` and, one sample a pixel, in"
            " `feature_reprojection`. OpenVINO computes the 2D renderers of Table 1, torch those of"
            " Table 2. What is in no stage is `other`.",
        )
    if followed := _named(METHODS, lines):
        yield _figure(
            "Quality along the path",
            add_picture(folder, "psnr-frames", partial(figures.quality_over_frames, followed)),
            "PSNR of every frame of the path with a ground truth. Hollow marks are cold frames, "
            "which had fewer preceding frames than the method looks back on.",
        )


def _figure(title: str, file: str, caption: str) -> str:
    return f"## {title}\n\n![{title}]({file})\n\n{caption}"


def _compared(
    title: str, shown: Mapping[tuple[str, str], str], lines: Lines, folder: Path
) -> Iterator[str]:
    """The middle one of the frames that all runs kept."""
    runs = _named(shown, lines)
    runs = [run for run in runs if run.views == runs[0].views]
    if runs and (frames := shown_frames(runs[0])):
        yield f"## {title}\n\nThe middle one of the {len(frames)} frames that were kept."
        yield from beside(runs, frames[len(frames) // 2], f"frames-{title.lower()}", folder)


def _named(wanted: Mapping[tuple[str, str], str], lines: Lines) -> list[Run]:
    """The first run of every line of `wanted` that has one, called as it says."""
    labels = {(table, line.label): line for table in lines for line in lines[table]}
    return [
        replace(labels[place].runs[0], label=name)
        for place, name in wanted.items()
        if place in labels and labels[place].runs
    ]


def _sources(lines: Lines) -> str:
    """Every run of the page: where in the store it lies and what made it."""
    listed = "\n".join(f"{run.key}  {run.record['command']}" for run in _runs(lines))
    return f"## Runs\n\nTheir keys in the store, and what was typed:\n\n```\n{listed}\n```"

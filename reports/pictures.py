"""Frames that several runs rendered, beside each other and beside the ground truth."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from PIL import Image

from bench.results import COLD
from reports.publish import add_picture
from reports.runs import Run
from reports.sheets import ZOOM, View, find_detail, write_sheet

BESIDE = 4
"""Renderings in one picture, beside the ground truth, at most; more runs get further pictures."""


def shown_frames(run: Run) -> list[str]:
    """The frames of which `run` kept pictures, as the names of these begin."""
    return sorted(path.name.split("-")[0] for path in run.pictures.glob("*-truth.png"))


def beside(runs: Sequence[Run], frame: str, stem: str, folder: Path) -> Iterator[str]:
    """Write the pictures of `frame` of `runs`; yield what the page in `folder` has about it."""
    truth = _read(runs[0].pictures / f"{frame}-truth.png")
    views = [_view(run, frame) for run in runs]
    detail = find_detail(truth, [view.rendering for view in views])
    name = runs[0].frames.set_index("frame")["name"][int(frame)]
    place = f"frame {int(frame) + 1} of {len(runs[0].frames)}"
    yield f"### {runs[0].facts['scene']}, {name}, {place}"
    width = math.ceil(len(views) / math.ceil(len(views) / BESIDE))  # no picture of a rest
    for first in range(0, len(views), width):
        group = views[first : first + width]
        draw = partial(write_sheet, truth, group, detail, runs[0].record["error_map"])
        file = add_picture(folder, f"{stem}-{frame}-{first}", draw)
        shown = ", ".join(view.titles[0] for view in group)
        yield f"![Ground truth, {shown}; a detail of each; error maps]({file})"
    yield (
        "PSNR and time above a picture are of this frame alone. The framed part, where"
        f" {detail.where}, is enlarged {ZOOM} times."
        f" Error maps show the {runs[0].record['error_map']}."
    )


def _view(run: Run, frame: str) -> View:
    """A shown frame of a run, titled with its own PSNR and time."""
    of_frame = run.frames.set_index("frame").loc[int(frame)]
    figures_shown = f"PSNR {of_frame['psnr']:.2f} dB, {of_frame['frame_ms']:.1f} ms"
    if of_frame["phase"] == COLD:
        figures_shown += ", cold"
    kinds = ("rendered", "error")
    pictures = [_read(run.pictures / f"{frame}-{kind}.png") for kind in kinds]
    return View((run.label, figures_shown), *pictures)


def _read(path: Path) -> np.ndarray:
    with Image.open(path) as picture:
        return np.asarray(picture.convert("RGB"))

"""Composes a frame of several runs into one image: truth, renderings, details, error maps."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont
from scipy.ndimage import uniform_filter

from bench.results import COLD
from bench.trajectories import spread
from reports.parts import Detail, Frame, Picture, View
from reports.runs import Run

MOST_FRAMES = 3
"""Maximum number of frames of a run on a page."""

MOST_RENDERINGS = 4
"""Maximum number of renderings in one image beside the ground truth; more runs get more images."""

NARROW_PX, WIDE_PX = 200, 400
"""Pictures within these widths are shown pixel by pixel; others are enlarged or reduced."""

GAP_PX = 8
LINE_PX = 24
INK, PAPER, MARK = (30, 30, 30), (255, 255, 255), (214, 0, 110)

ZOOM = 4
"""Magnification of the detail relative to its picture."""


@dataclass(frozen=True)
class Band:
    """One row of panels below a caption; None leaves a place empty."""

    caption: str
    panels: Sequence[Image.Image | None]


def kept_frames(runs: Sequence[Run]) -> list[str]:
    """File name prefixes of the frames whose pictures all `runs` kept.

    At most `MOST_FRAMES` of them, evenly spread.
    """
    kept = [{path.name.split("-")[0] for path in run.pictures.glob("*-truth.png")} for run in runs]
    common = sorted(set.intersection(*kept))
    return [common[index] for index in spread(len(common), MOST_FRAMES)]


def frame_section(runs: Sequence[Run], frame: str, stem: str) -> Iterator[str | Frame]:
    """`frame` of `runs` as parts of a page: heading, pictures and caption."""
    truth = _read(runs[0].pictures / f"{frame}-truth.png")
    views = [_view(run, frame) for run in runs]
    detail = find_detail(truth, [view.rendering for view in views])
    view = runs[0].frames.set_index("frame")["name"][int(frame)]
    number = f"frame {int(frame) + 1} of {len(runs[0].frames)}"
    name, errors = f"{runs[0].facts['scene']}, {view}, {number}", runs[0].record["error_map"]
    yield f"### {name}"
    yield Frame(name, f"{stem}-{frame}", truth, views, detail, errors)
    yield (
        "PSNR and time of a picture are of this frame alone. The framed part, where"
        f" {detail.where}, can be seen {ZOOM} times enlarged. Error maps show the {errors}."
    )


def still_images(frame: Frame) -> Iterator[Picture]:
    """Static images that show all renderings of `frame`, at most `MOST_RENDERINGS` in each."""
    count = len(frame.views)
    width = math.ceil(count / math.ceil(count / MOST_RENDERINGS))  # evenly filled images
    for first in range(0, count, width):
        group = frame.views[first : first + width]
        draw = partial(write_image, frame.truth, group, frame.detail, frame.errors)
        shown = ", ".join(view.titles[0] for view in group)
        shows = f"Ground truth, {shown}; a detail of each; error maps"
        yield Picture(f"{frame.stem}-{first}", shows, draw)


def _view(run: Run, frame: str) -> View:
    """A kept frame of a run, with its own PSNR and time in the title."""
    figures = run.frames.set_index("frame").loc[int(frame)]
    title = f"PSNR {figures['psnr']:.2f} dB, {figures['frame_ms']:.1f} ms"
    if figures["phase"] == COLD:
        title += ", cold"
    pictures = [_read(run.pictures / f"{frame}-{kind}.png") for kind in ("rendered", "error")]
    return View((run.label, title), *pictures)


def _read(path: Path) -> np.ndarray:
    with Image.open(path) as picture:
        return np.asarray(picture.convert("RGB"))


def find_detail(truth: np.ndarray, renderings: Sequence[np.ndarray]) -> Detail:
    """Find the part of a frame where its pictures differ most, on average.

    Several renderings are compared with each other, a single one with the ground truth. If nothing
    differs, the centre is used.
    """
    alone = len(renderings) == 1
    stack = np.stack([*renderings, truth] if alone else renderings).astype(float)
    difference = (stack.max(axis=0) - stack.min(axis=0)).mean(axis=-1)  # [H, W]
    height, width = difference.shape
    high, wide = max(1, height // ZOOM), max(1, width // ZOOM)
    middle = (height // 2, width // 2)
    if difference.any():
        mean = uniform_filter(difference, (high, wide), mode="constant")
        middle = divmod(int(mean.argmax()), width)
    top = min(max(0, middle[0] - high // 2), height - high)
    left = min(max(0, middle[1] - wide // 2), width - wide)
    where = "the error is largest" if alone else "the renderings differ most"
    return Detail((left, top, left + wide, top + high), where)


def write_image(
    truth: np.ndarray, views: Sequence[View], detail: Detail, errors: str, path: Path
) -> None:
    """Write a PNG with the ground truth, the `views`, the `detail` of each, and error maps.

    `errors` says what the error maps show. A single view takes two rows, several take three.
    """
    pictures = [truth, *(view.rendering for view in views)]
    maps = [view.error for view in views]
    titles: list[tuple[str, ...]] = [("ground truth",), *(view.titles for view in views)]
    enlarged = f"detail, {ZOOM} times enlarged, where {detail.where}"
    if len(views) == 1:
        pictures, maps, titles = [*pictures, *maps], [], [*titles, ("error map",)]
        enlarged += f"; error map: {errors}"
    bands = [
        Band("", [_whole(picture, detail) for picture in pictures]),
        Band(enlarged, [_part(picture, detail) for picture in pictures]),
    ]
    if maps:
        bands.append(Band(f"error maps: {errors}", [None, *(_whole(m, detail) for m in maps)]))
    _compose(titles, bands).save(path)


def _shown(height: int, width: int) -> tuple[int, int]:
    """Width and height of the panel of a picture."""
    scale = -(-NARROW_PX // width) if width < NARROW_PX else min(1.0, WIDE_PX / width)
    return round(width * scale), round(height * scale)


def _whole(picture: np.ndarray, detail: Detail) -> Image.Image:
    size = _shown(*picture.shape[:2])
    scale = size[0] / picture.shape[1]
    how = Image.Resampling.NEAREST if scale > 1 else Image.Resampling.BOX
    panel = Image.fromarray(picture).resize(size, how)
    _outline(panel, [round(edge * scale) for edge in detail.box])
    return panel


def _part(picture: np.ndarray, detail: Detail) -> Image.Image:
    """The outlined part, enlarged to the size of the panel without interpolation."""
    part = Image.fromarray(picture).crop(detail.box)
    panel = part.resize(_shown(*picture.shape[:2]), Image.Resampling.NEAREST)
    _outline(panel, [0, 0, panel.width - 1, panel.height - 1])
    return panel


def _outline(panel: Image.Image, box: Sequence[int]) -> None:
    ImageDraw.Draw(panel).rectangle(box, outline=MARK, width=2)


def _compose(titles: Sequence[Sequence[str]], bands: Sequence[Band]) -> Image.Image:
    """Arrange panels in rows and columns, with titles above columns and captions above rows."""
    width, height = next(panel.size for panel in bands[0].panels if panel)
    heads = max(map(len, titles))
    captions = sum(bool(band.caption) for band in bands)
    total = LINE_PX * (heads + captions) + (height + GAP_PX) * len(bands) + 2 * GAP_PX
    image = Image.new("RGB", (GAP_PX + (width + GAP_PX) * len(titles), total), PAPER)
    draw = ImageDraw.Draw(image)
    across = [GAP_PX + (width + GAP_PX) * column for column in range(len(titles))]
    for left, lines in zip(across, titles, strict=True):
        for row, line in enumerate(lines):
            _write(draw, (left, GAP_PX + LINE_PX * row), line, width)
    down = GAP_PX + LINE_PX * heads
    for band in bands:
        if band.caption:
            _write(draw, (GAP_PX, down), band.caption, image.width - 2 * GAP_PX)
            down += LINE_PX
        for left, panel in zip(across, band.panels, strict=True):
            if panel:
                image.paste(panel, (left, down))
        down += height + GAP_PX
    return image


def _write(draw: ImageDraw.ImageDraw, place: tuple[int, int], text: str, room_px: int) -> None:
    """Write one line of text, in a smaller size if it does not fit."""
    size = 16
    while size > 8 and draw.textlength(text, font=ImageFont.load_default(size)) > room_px:
        size -= 1
    draw.text(place, text, fill=INK, font=ImageFont.load_default(size))

"""What a page shows beside its text: plots, and a frame of several runs for comparison.

`publish` writes the same parts of a page as Markdown and as HTML. In Markdown, a frame is one image
of truth, renderings, details and error maps.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import matplotlib
import numpy as np
from PIL import Image, ImageDraw, ImageFont
from scipy.ndimage import uniform_filter

from bench.kinds import Size
from bench.results import COLD
from bench.trajectories import spread
from reports.runs import Run, Runs, read_picture
from reports.tables import Rows, Table

MOST_FRAMES = 3  # maximum number of frames of a run on a page

MOST_RENDERINGS = 4
"""Maximum number of renderings in one image beside the ground truth; more runs get more images."""

NARROW_PX, WIDE_PX = 200, 400
"""Pictures within these widths are shown pixel by pixel; others are enlarged or reduced."""

GAP_PX = 8
LINE_PX = 24
INK, PAPER, MARK = (30, 30, 30), (255, 255, 255), (214, 0, 110)

ZOOM = 4  # magnification of the detail relative to its picture

Box = tuple[int, int, int, int]  # left, top, right, bottom
Band = tuple[str, Sequence[Image.Image]]  # one row of panels below a caption


@dataclass(frozen=True)
class Picture:
    """A drawing: the prefix of its file name, and what it shows, in words.

    `draw` writes it to a path, in the format given by the ending. The marks of a plot, by the `gid`
    that `draw` gives their artists, are their figures in words and the keys of the runs behind.
    """

    stem: str
    shows: str
    draw: Callable[[Path], object]
    marks: Mapping[str, tuple[str, tuple[str, ...]]] = field(default_factory=dict)


@dataclass(frozen=True)
class RunView:
    """A frame rendered by one run: titles, rendering and error map, uint8 [H, W, 3] each."""

    titles: tuple[str, ...]
    rendering: np.ndarray
    error: np.ndarray


@dataclass(frozen=True)
class ComparedFrame:
    """A frame of several runs, for comparison.

    `name` has scene, view and number; `stem` begins the names of its files; `truth` is uint8
    [H, W, 3]. The part `box` is enlarged; `where` says why this part was chosen, and `errors` what
    the error maps show.
    """

    name: str
    stem: str
    truth: np.ndarray
    views: Sequence[RunView]
    box: Box
    where: str
    errors: str


Part = str | Table | Picture | ComparedFrame  # a part that is a string is Markdown
Parts = Iterator[Part]  # of a page


def kept_frames(runs: Runs) -> list[str]:
    """File name prefixes of at most `MOST_FRAMES` frames that all `runs` kept, evenly spread."""
    kept = [{path.name.split("-")[0] for path in run.pictures.glob("*-truth.png")} for run in runs]
    common = sorted(set.intersection(*kept))
    return [common[index] for index in spread(len(common), MOST_FRAMES)]


def frame_section(runs: Runs, frame: str, stem: str) -> Iterator[str | ComparedFrame]:
    """`frame` of `runs` as parts of a page: heading, pictures and caption."""
    first = runs[0]
    truth = read_picture(first.pictures / f"{frame}-truth.png")
    views = [_view(run, frame) for run in runs]
    box, where = find_detail(truth, [view.rendering for view in views])
    view = first.frames.set_index("frame")["name"][int(frame)]
    place = f"frame {int(frame) + 1} of {len(first.frames)}"
    name, errors = f"{first.facts['scene']}, {view}, {place}", first.record["error_map"]
    yield f"### {name}"
    yield ComparedFrame(name, f"{stem}-{frame}", truth, views, box, where, errors)
    yield (
        f"PSNR is that of this frame, the time the mean of all steady ones. The framed part, where"
        f" {where}, can be seen {ZOOM} times enlarged. Error maps show the {errors}."
    )


def _view(run: Run, frame: str) -> RunView:
    """A kept frame of a run, with its PSNR and the time of a steady frame, or its own, if cold."""
    figures = run.frames.set_index("frame").loc[int(frame)]
    cold = figures["phase"] == COLD
    ms = figures["frame_ms"] if cold else run.values["frame_ms"]
    title = f"PSNR {figures['psnr']:.2f} dB, {ms:,.1f} ms{', cold' if cold else ''}"
    files = (run.pictures / f"{frame}-{kind}.png" for kind in ("rendered", "error"))
    return RunView((run.label, title), *map(read_picture, files))


def find_detail(truth: np.ndarray, renderings: Sequence[np.ndarray]) -> tuple[Box, str]:
    """The part of a frame where its pictures differ most, on average, and what differs there.

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
    return (left, top, left + wide, top + high), where


def still_images(frame: ComparedFrame) -> Iterator[Picture]:
    """Static images that show all renderings of `frame`, at most `MOST_RENDERINGS` in each."""
    count = len(frame.views)
    width = math.ceil(count / math.ceil(count / MOST_RENDERINGS))  # evenly filled images
    for first in range(0, count, width):
        group = replace(frame, views=frame.views[first : first + width])
        shown = ", ".join(view.titles[0] for view in group.views)
        shows = f"Ground truth, {shown}; a detail of each; error maps"
        yield Picture(f"{frame.stem}-{first}", shows, partial(write_image, group))


def write_image(frame: ComparedFrame, path: Path) -> None:
    """Write a PNG with the ground truth, the views of `frame`, a detail of each, and error maps.

    A single view takes two rows, several take three.
    """
    height, width = frame.truth.shape[:2]
    scale = -(-NARROW_PX // width) if width < NARROW_PX else min(1.0, WIDE_PX / width)
    size = round(width * scale), round(height * scale)
    scale = size[0] / width
    outline = [round(edge * scale) for edge in frame.box]

    def whole(picture: np.ndarray) -> Image.Image:
        how = Image.Resampling.NEAREST if scale > 1 else Image.Resampling.BOX
        return _outlined(Image.fromarray(picture).resize(size, how), outline)

    def part(picture: np.ndarray) -> Image.Image:
        enlarged = Image.fromarray(picture).crop(frame.box).resize(size, Image.Resampling.NEAREST)
        return _outlined(enlarged, [0, 0, size[0] - 1, size[1] - 1])

    pictures = [frame.truth, *(view.rendering for view in frame.views)]
    maps = [view.error for view in frame.views]
    titles: list[tuple[str, ...]] = [("ground truth",), *(view.titles for view in frame.views)]
    caption = f"detail, {ZOOM} times enlarged, where {frame.where}"
    if len(frame.views) == 1:
        pictures, maps, titles = [*pictures, *maps], [], [*titles, ("error map",)]
        caption += f"; error map: {frame.errors}"
    bands: list[Band] = [("", list(map(whole, pictures))), (caption, list(map(part, pictures)))]
    if maps:
        bands.append((f"error maps: {frame.errors}", [_error_colours(size), *map(whole, maps)]))
    _compose(titles, bands, size).save(path)


def _error_colours(size: Size) -> Image.Image:
    """A panel with the colours of an error map, from no error on."""
    colours = matplotlib.colormaps["inferno"](np.linspace(0, 1, size[0]), bytes=True)[None, :, :3]
    panel = Image.new("RGB", size, PAPER)
    panel.paste(Image.fromarray(colours).resize((size[0], LINE_PX)), (0, 0))
    return panel


def _outlined(panel: Image.Image, box: Sequence[int]) -> Image.Image:
    ImageDraw.Draw(panel).rectangle(box, outline=MARK, width=2)
    return panel


def _compose(titles: Rows, bands: Sequence[Band], size: Size) -> Image.Image:
    """Arrange panels of this size in rows and columns, below titles and captions."""
    width, height = size
    heads = max(map(len, titles))
    lines = heads + sum(bool(caption) for caption, _ in bands)
    total = LINE_PX * lines + (height + GAP_PX) * len(bands) + 2 * GAP_PX
    image = Image.new("RGB", (GAP_PX + (width + GAP_PX) * len(titles), total), PAPER)
    across = [GAP_PX + (width + GAP_PX) * column for column in range(len(titles))]
    for left, texts in zip(across, titles, strict=True):
        for row, text in enumerate(texts):
            _write(image, (left, GAP_PX + LINE_PX * row), text, width)
    down = GAP_PX + LINE_PX * heads
    for caption, panels in bands:
        if caption:
            _write(image, (GAP_PX, down), caption, image.width - 2 * GAP_PX)
            down += LINE_PX
        for left, panel in zip(across, panels, strict=True):
            image.paste(panel, (left, down))
        down += height + GAP_PX
    return image


def _write(image: Image.Image, place: Size, text: str, room_px: int) -> None:
    """Write one line of text, in a smaller size if it does not fit."""
    draw, size = ImageDraw.Draw(image), 16
    while size > 8 and draw.textlength(text, font=ImageFont.load_default(size)) > room_px:
        size -= 1
    draw.text(place, text, fill=INK, font=ImageFont.load_default(size))

"""A frame of several runs in one picture: ground truth, renderings, a detail of each, errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont
from scipy.ndimage import uniform_filter

NARROW_PX, WIDE_PX = 200, 400
"""Between these a picture is shown pixel by pixel; others are enlarged or reduced."""

GAP_PX = 8
LINE_PX = 24
INK, PAPER, MARK = (30, 30, 30), (255, 255, 255), (214, 0, 110)

ZOOM = 4
"""How many times a detail is enlarged over the picture it is taken from."""


@dataclass(frozen=True)
class View:
    """A frame as one run rendered it: its titles, and uint8 [H, W, 3] with its error map."""

    titles: tuple[str, ...]
    rendering: np.ndarray
    error: np.ndarray


@dataclass(frozen=True)
class Band:
    """One line of panels below what is said about it; None leaves a place empty."""

    caption: str
    panels: Sequence[Image.Image | None]


@dataclass(frozen=True)
class Detail:
    """The part of a frame that is shown enlarged: left, top, right, bottom, and why this one."""

    box: tuple[int, int, int, int]
    where: str


def find_detail(truth: np.ndarray, renderings: Sequence[np.ndarray]) -> Detail:
    """The part of a frame in which its pictures differ most, in the mean over that part.

    Of several renderings, from each other; of a single one, from the ground truth. Where nothing
    differs, it is the middle.
    """
    alone = len(renderings) == 1
    stack = np.stack([*renderings, truth] if alone else renderings).astype(float)
    spread = (stack.max(axis=0) - stack.min(axis=0)).mean(axis=-1)  # [H, W]
    height, width = spread.shape
    high, wide = max(1, height // ZOOM), max(1, width // ZOOM)
    middle = (height // 2, width // 2)
    if spread.any():
        mean = uniform_filter(spread, (high, wide), mode="constant")
        middle = divmod(int(mean.argmax()), width)
    top = min(max(0, middle[0] - high // 2), height - high)
    left = min(max(0, middle[1] - wide // 2), width - wide)
    where = "the error is largest" if alone else "the renderings differ most"
    return Detail((left, top, left + wide, top + high), where)


def write_sheet(
    truth: np.ndarray, views: Sequence[View], detail: Detail, errors: str, path: Path
) -> None:
    """Write the PNG that shows the ground truth and the `views`, each with the `detail`.

    `errors` says what the error maps show. A single view takes two lines, several take three.
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
    """The picture with the detail outlined."""
    size = _shown(*picture.shape[:2])
    enlarged = size[0] > picture.shape[1]
    panel = Image.fromarray(picture).resize(
        size, Image.Resampling.NEAREST if enlarged else Image.Resampling.BOX
    )
    scale = size[0] / picture.shape[1]
    ImageDraw.Draw(panel).rectangle(
        [round(edge * scale) for edge in detail.box], outline=MARK, width=2
    )
    return panel


def _part(picture: np.ndarray, detail: Detail) -> Image.Image:
    """The outlined part, as large as the picture is shown, its pixels kept apart."""
    part = Image.fromarray(picture).crop(detail.box)
    panel = part.resize(_shown(*picture.shape[:2]), Image.Resampling.NEAREST)
    ImageDraw.Draw(panel).rectangle(
        (0, 0, panel.width - 1, panel.height - 1), outline=MARK, width=2
    )
    return panel


def _compose(titles: Sequence[Sequence[str]], bands: Sequence[Band]) -> Image.Image:
    """Panels in lines and columns, titles above the columns, captions above the lines."""
    width, height = next(panel.size for panel in bands[0].panels if panel)
    heads = max(map(len, titles))
    captions = sum(bool(band.caption) for band in bands)
    total = LINE_PX * (heads + captions) + (height + GAP_PX) * len(bands) + 2 * GAP_PX
    sheet = Image.new("RGB", (GAP_PX + (width + GAP_PX) * len(titles), total), PAPER)
    draw = ImageDraw.Draw(sheet)
    across = [GAP_PX + (width + GAP_PX) * column for column in range(len(titles))]
    for left, lines in zip(across, titles, strict=True):
        for number, line in enumerate(lines):
            _write(draw, (left, GAP_PX + LINE_PX * number), line, width)
    down = GAP_PX + LINE_PX * heads
    for band in bands:
        if band.caption:
            _write(draw, (GAP_PX, down), band.caption, sheet.width - 2 * GAP_PX)
            down += LINE_PX
        for left, panel in zip(across, band.panels, strict=True):
            if panel:
                sheet.paste(panel, (left, down))
        down += height + GAP_PX
    return sheet


def _write(draw: ImageDraw.ImageDraw, place: tuple[int, int], text: str, room_px: int) -> None:
    """Write one line, smaller where it would not fit."""
    size = 16
    while size > 8 and draw.textlength(text, font=ImageFont.load_default(size)) > room_px:
        size -= 1
    draw.text(place, text, fill=INK, font=ImageFont.load_default(size))

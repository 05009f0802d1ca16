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


def write_sheet(truth: np.ndarray, views: Sequence[View], errors: str, path: Path) -> None:
    """Write the PNG that shows the ground truth, the `views` and what `errors` says of errors."""
    top, left, height, width = region(truth, [view.rendering for view in views])
    box = (left, top, left + width, top + height)
    pictures = [truth, *(view.rendering for view in views)]
    maps = [view.error for view in views]
    titles: list[tuple[str, ...]] = [("ground truth",), *(view.titles for view in views)]
    if len(views) == 1:  # one line is enough
        pictures, maps, titles = [*pictures, *maps], [], [*titles, ("error", errors)]
    what = "the error is largest" if len(views) == 1 else "the renderings differ most"
    bands = [
        Band("", [_whole(picture, box) for picture in pictures]),
        Band(f"detail, where {what}", [_detail(picture, box) for picture in pictures]),
    ]
    if maps:
        bands.append(Band(f"error: {errors}", [None, *(_whole(error, box) for error in maps)]))
    _compose(titles, bands).save(path)


def region(truth: np.ndarray, renderings: Sequence[np.ndarray]) -> tuple[int, int, int, int]:
    """Top, left, height, width of the part in which pictures differ most, in the mean over it.

    Of several renderings, from each other; of a single one, from the ground truth. Where nothing
    differs, it is the middle.
    """
    stack = np.stack([*renderings, truth] if len(renderings) == 1 else renderings).astype(float)
    spread = (stack.max(axis=0) - stack.min(axis=0)).mean(axis=-1)  # [H, W]
    size = tuple(max(1, side // ZOOM) for side in spread.shape)
    centre = tuple(side // 2 for side in spread.shape)
    if spread.any():
        mean = uniform_filter(spread, size, mode="constant")
        centre = tuple(map(int, np.unravel_index(mean.argmax(), mean.shape)))
    corner = (
        min(max(0, middle - part // 2), side - part)
        for middle, part, side in zip(centre, size, spread.shape, strict=True)
    )
    top, left = corner
    return top, left, size[0], size[1]


def _shown(height: int, width: int) -> tuple[int, int]:
    """Width and height of the panel of a picture."""
    scale = -(-NARROW_PX // width) if width < NARROW_PX else min(1.0, WIDE_PX / width)
    return round(width * scale), round(height * scale)


def _whole(picture: np.ndarray, box: tuple[int, int, int, int]) -> Image.Image:
    """The picture with the detail outlined."""
    size = _shown(*picture.shape[:2])
    enlarged = size[0] > picture.shape[1]
    panel = Image.fromarray(picture).resize(
        size, Image.Resampling.NEAREST if enlarged else Image.Resampling.BOX
    )
    scale = size[0] / picture.shape[1]
    ImageDraw.Draw(panel).rectangle([round(edge * scale) for edge in box], outline=MARK, width=2)
    return panel


def _detail(picture: np.ndarray, box: tuple[int, int, int, int]) -> Image.Image:
    """The outlined part, as large as the picture is shown, its pixels kept apart."""
    part = Image.fromarray(picture).crop(box)
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

"""What a page is made of. `publish` writes the same parts as Markdown and as HTML."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from reports.tables import Table


@dataclass(frozen=True)
class Picture:
    """A drawing.

    Attributes:
        stem: how the name of its file begins.
        shows: what it shows, in words, for those who do not see it.
        draw: writes it to a path, in the format that the ending names.
    """

    stem: str
    shows: str
    draw: Callable[[Path], object]


@dataclass(frozen=True)
class Mark:
    """A mark of a plot: its name and figures in words, and the keys of the runs behind it."""

    says: str
    sources: tuple[str, ...]


@dataclass(frozen=True)
class Plot(Picture):
    """A drawing by matplotlib. `marks` are by the `gid` that `draw` gives to the artist of each."""

    marks: Mapping[str, Mark] = field(default_factory=dict)


@dataclass(frozen=True)
class View:
    """A frame as one run rendered it: titles, and uint8 [H, W, 3] with its error map."""

    titles: tuple[str, ...]
    rendering: np.ndarray
    error: np.ndarray


@dataclass(frozen=True)
class Detail:
    """The part of a frame that is enlarged: left, top, right, bottom, and why this part."""

    box: tuple[int, int, int, int]
    where: str


@dataclass(frozen=True)
class Frame:
    """A frame of several runs, to be compared.

    Attributes:
        name: scene, view and number.
        stem: how the names of its files begin.
        truth: uint8 [H, W, 3].
        errors: what the error maps show.
    """

    name: str
    stem: str
    truth: np.ndarray
    views: Sequence[View]
    detail: Detail
    errors: str


Part = str | Table | Plot | Frame
"""A text is Markdown."""

"""The parts of a page. `publish` writes the same parts as Markdown and as HTML."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from reports.tables import Table


@dataclass(frozen=True)
class Mark:
    """A mark in a plot: its name and figures in words, and the keys of the runs behind it."""

    says: str
    sources: tuple[str, ...]


@dataclass(frozen=True)
class Picture:
    """A drawing: the prefix of its file name, and what it shows, in words.

    `draw` writes it to a path, in the format given by the ending. In a plot by matplotlib, `marks`
    are keyed by the `gid` that `draw` gives their artists.
    """

    stem: str
    shows: str
    draw: Callable[[Path], object]
    marks: Mapping[str, Mark] = field(default_factory=dict)


@dataclass(frozen=True)
class View:
    """A frame rendered by one run: titles, rendering and error map, uint8 [H, W, 3] each."""

    titles: tuple[str, ...]
    rendering: np.ndarray
    error: np.ndarray


@dataclass(frozen=True)
class Frame:
    """A frame of several runs, for comparison.

    `name` is that of the scene, view and number; `stem` begins the names of its files; `truth` is
    uint8 [H, W, 3]. The part `box` (left, top, right, bottom) is enlarged; `where` says why this
    part was chosen, and `errors` what the error maps show.
    """

    name: str
    stem: str
    truth: np.ndarray
    views: Sequence[View]
    box: tuple[int, int, int, int]
    where: str
    errors: str


Part = str | Table | Picture | Frame
"""A part that is a string is Markdown."""

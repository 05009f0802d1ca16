"""What a network on cells is told of each, and the pixels that its answer makes.

`lift` brings all that is known of a cell of s x s pixels into one row: the present low-resolution
sample, the features of preceding frames, the preceding picture, the surface. `draw` makes pixels of
what the network answers. Colours are told and drawn less their background, so that nothing is 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from bench.types import check_shape
from methods.kernels.dispatch import implementation

TAPS = 9
"""Low-resolution samples that a pixel's base is made of."""

Told = tuple[Tensor, Tensor]


@dataclass(frozen=True)
class Layout:
    """The columns of a row.

    Attributes:
        channels: K.
        frames: L.
        scale: s.
        history: the preceding picture has columns.
        surface: the surface of each pixel has columns.
    """

    channels: int
    frames: int
    scale: int
    history: bool
    surface: bool

    @cached_property
    def groups(self) -> list[tuple[str, int, int]]:
        """Name, slots, features a slot: colour, how far something is there, the rest."""
        cell, features = self.scale**2, self.channels + 1
        return [
            ("present", 1, features),
            *((f"preceding {age}", cell, features) for age in range(self.frames)),
            *[("history", cell, 4)] * self.history,
            *[("surface", cell, features)] * self.surface,
        ]

    @cached_property
    def begins(self) -> dict[str, int]:
        """The first column of each group."""
        begins, column = {}, 0
        for name, slots, features in self.groups:
            begins[name] = column
            column += slots * features
        return begins

    @property
    def width(self) -> int:
        """Columns of a row."""
        return sum(slots * features for _, slots, features in self.groups)


def lift(
    values: Tensor,
    alpha: Tensor,
    background: Tensor,
    cells: Tensor,
    preceding: Sequence[Told],
    history: Told | None,
    surface: Told | None,
    layout: Layout,
    phase: tuple[float, float] = (0.0, 0.0),
    *,
    multiple: int = 1,
    backend: str = "auto",
) -> tuple[Tensor, Tensor]:
    """The rows of some cells, and the base that a network corrects there.

    The base is the present RGB enlarged bilinearly; beyond the frame its border goes on. Colours of
    history and surface are told less the base.

    Differentiable in `values`, `alpha` and what `preceding` and `surface` have, not in `history`.

    Args:
        values: [h, w, K] features of the present low-resolution frame.
        alpha: [h, w] opacity.
        background: [K] that features are composited on.
        cells: [N] int64 low-resolution pixels, counted row by row, 0 to h w - 1.
        preceding: newest first, no more than `layout.frames`: features [P, K] of points and the
            index [h s, w s] int32 of the one that each pixel shows, -1 for none; columns of frames
            that are missing are 0.
        history: preceding picture [N, s^2, 3] in the cells, and where it is known, [N, s^2] in
            {0, 1}; None: columns of 0.
        surface: features and, last, opacity [P, K + 1], and the index [N, s^2] int32 of the one
            that each pixel shows, -1 for none; None: columns of 0.
        layout: of the rows.
        phase: (u, v) in full-resolution pixels of the samples of the frame beside the middle of
            their cell.
        multiple: rows of 0 follow up to a multiple, 1 or more, of this.

    Returns:
        base [N, s^2, 3] and rows [N or more, layout.width].

    Raises:
        ValueError: a shape is wrong, or an index names no point.
    """
    height, width, count, pixels = *values.shape[:2], len(cells), layout.scale**2
    check_shape("values", values, None, None, layout.channels)
    check_shape("alpha", alpha, height, width)
    check_shape("background", background, layout.channels)
    check_shape("cells", cells, None)
    if len(preceding) > layout.frames:
        raise ValueError(f"preceding: expected at most {layout.frames}, got {len(preceding)}")
    if (history is not None and not layout.history) or (surface is not None and not layout.surface):
        raise ValueError(f"history, surface: expected None without their columns, got {layout}")
    for points, index in preceding:
        check_shape("preceding values", points, None, layout.channels)
        check_shape("preceding index", index, height * layout.scale, width * layout.scale)
    if history is not None:
        check_shape("history values", history[0], count, pixels, 3)
        check_shape("history valid", history[1], count, pixels)
    if surface is not None:
        check_shape("surface values", surface[0], None, layout.channels + 1)
        check_shape("surface index", surface[1], count, pixels)
    across, down = (_tent(layout.scale, shift) for shift in phase)
    taps = (down[:, None, :, None] * across[None, :, None, :]).reshape(-1, TAPS).to(values)
    kernel = implementation("lift", backend, values.device)
    rows = multiple * -(-count // multiple)
    with torch.autocast(values.device.type, enabled=False):
        return kernel.lift(
            values, alpha, background, cells, preceding, history, surface, layout, taps, rows
        )


def draw(
    base: Tensor,
    rows: Tensor,
    answer: Tensor,
    matrix: Tensor | None,
    layout: Layout,
    *,
    backend: str = "auto",
) -> Tensor:
    """Pixels [N, s^2, 3], less the background, of cells of which `lift` told `base` and `rows`.

    base + correction + share * (preceding picture - base) + matrix [surface less base, opacity,
    rest], the colours of the surface weighed by its opacity.

    Differentiable in all.

    Args:
        base: [N, s^2, 3].
        rows: [R, layout.width], R at least N; of what is more nothing is drawn.
        answer: [R, s^2 (3 + layout.history)] of each pixel, correction and logit of the share.
        matrix: [R, 3 (K + 1)] that the pixels of a cell share; None without surface.

    Raises:
        ValueError: a shape is wrong.
    """
    count, pixels = len(rows), layout.scale**2
    check_shape("base", base, None, pixels, 3)
    check_shape("rows", rows, None, layout.width)
    if count < len(base):
        raise ValueError(f"rows: expected one for each of {len(base)} cells, got {count}")
    check_shape("answer", answer, count, pixels * (3 + layout.history))
    if (matrix is None) == layout.surface:
        raise ValueError("matrix: expected one with layout.surface, None without")
    if matrix is not None:
        check_shape("matrix", matrix, count, 3 * (layout.channels + 1))
    kernel = implementation("lift", backend, base.device)
    with torch.autocast(base.device.type, enabled=False):
        return kernel.draw(base, rows, answer, matrix, layout)


def _tent(scale: int, shift: float) -> Tensor:
    """[s, 3] weights of the samples at -1, 0, 1 for the s pixels between -1/2 and 1/2."""
    place = (torch.arange(scale) + 0.5 - shift) / scale - 0.5
    return (1 - (place[:, None] - torch.tensor((-1.0, 0.0, 1.0))).abs()).clamp(min=0)

"""Gathers the inputs of a cell of s x s pixels into one row, and turns network output into pixels.

`space_to_depth` collects a cell's inputs in one row: the current low-resolution sample, features of
preceding frames, the preceding picture, the surface. `depth_to_space` converts the network's output
to pixels. Colours are relative to the background, so that empty space is 0.
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
"""Low-resolution samples that are interpolated to a pixel's base colour."""

Pair = tuple[Tensor, Tensor]


@dataclass(frozen=True)
class Layout:
    """The columns of a row.

    Attributes:
        channels: K.
        frames: L.
        scale: s.
        history: whether there are columns for the preceding picture.
        surface: whether there are columns for the surface of each pixel.
    """

    channels: int
    frames: int
    scale: int
    history: bool
    surface: bool

    @cached_property
    def groups(self) -> list[tuple[str, int, int]]:
        """(name, slots, features per slot); features are colour, opacity or validity, the rest."""
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


@dataclass(frozen=True)
class CellInputs:
    """The inputs of N cells.

    Attributes:
        values: [h, w, K] features of the current low-resolution frame.
        alpha: [h, w] opacity.
        background: [K] on which features are composited.
        cells: [N] int64 low-resolution pixels, numbered row by row, 0 to h w - 1.
        preceding: newest first, at most `Layout.frames`: features [P, K] of points, and for each
            pixel the index [h s, w s] int32 of the point that it shows, -1 for none. Columns of
            missing frames are 0.
        history: preceding picture [N, s^2, 3] in the cells, and its validity [N, s^2] in {0, 1};
            None: columns of 0.
        surface: features and, last, opacity [P, K + 1] of points, and for each pixel the index
            [N, s^2] int32 of the point that it shows, -1 for none; None: columns of 0.
    """

    values: Tensor
    alpha: Tensor
    background: Tensor
    cells: Tensor
    preceding: Sequence[Pair] = ()
    history: Pair | None = None
    surface: Pair | None = None

    def check(self, layout: Layout) -> None:
        """Raise `ValueError` unless all shapes match `layout`."""
        height, width, count, pixels = *self.values.shape[:2], len(self.cells), layout.scale**2
        history, surface = self.history, self.surface
        check_shape("values", self.values, None, None, layout.channels)
        check_shape("alpha", self.alpha, height, width)
        check_shape("background", self.background, layout.channels)
        check_shape("cells", self.cells, None)
        if len(self.preceding) > layout.frames:
            raise ValueError(
                f"preceding: expected at most {layout.frames}, got {len(self.preceding)}"
            )
        if (history and not layout.history) or (surface and not layout.surface):
            raise ValueError(f"history, surface: expected None without their columns, got {layout}")
        for points, index in self.preceding:
            check_shape("preceding values", points, None, layout.channels)
            check_shape("preceding index", index, height * layout.scale, width * layout.scale)
        if history is not None:
            check_shape("history values", history[0], count, pixels, 3)
            check_shape("history valid", history[1], count, pixels)
        if surface is not None:
            check_shape("surface values", surface[0], None, layout.channels + 1)
            check_shape("surface index", surface[1], count, pixels)


def space_to_depth(
    inputs: CellInputs, layout: Layout, *, multiple: int = 1, backend: str = "auto"
) -> Pair:
    """The base colours of cells, which a network corrects, and the rows of the cells.

    The base is the current RGB upsampled bilinearly with a repeated border. Colours of history and
    surface are relative to the base.

    Differentiable in `values`, `alpha` and the features of `preceding` and `surface`, not in
    `history`.

    Args:
        layout: the columns of the rows.
        multiple: rows of 0 are appended up to a positive multiple of this.

    Returns:
        base [N, s^2, 3] and rows [N or more, layout.width].

    Raises:
        ValueError: a shape is wrong, or an index is out of range.
    """
    inputs.check(layout)
    values, count = inputs.values, len(inputs.cells)
    tent = _tent(layout.scale)
    taps = (tent[:, None, :, None] * tent[None, :, None, :]).reshape(-1, TAPS)
    taps = taps.to(values.device, values.dtype, non_blocking=True)
    kernel = implementation(__name__, backend, values.device)
    rows = multiple * -(-count // multiple)
    with torch.autocast(values.device.type, enabled=False):
        return kernel.space_to_depth(inputs, layout, taps, rows)


def depth_to_space(
    base: Tensor,
    rows: Tensor,
    output: Tensor,
    matrix: Tensor | None,
    layout: Layout,
    *,
    backend: str = "auto",
) -> Tensor:
    """Pixels [N, s^2, 3], relative to the background, of cells with `base` and `rows`.

    A pixel is base + correction + share * (preceding picture - base) + matrix [surface - base,
    opacity, rest], with the colours of the surface weighted by its opacity. Differentiable in all.

    Args:
        base: [N, s^2, 3] from `space_to_depth`.
        rows: [R, layout.width] from `space_to_depth`, R >= N; surplus rows are ignored.
        output: [R, s^2 (3 + layout.history)]: for each pixel, correction and logit of the share.
        matrix: [R, 3 (K + 1)], shared by the pixels of a cell; None without surface.

    Raises:
        ValueError: a shape is wrong.
    """
    count, pixels = len(rows), layout.scale**2
    check_shape("base", base, None, pixels, 3)
    check_shape("rows", rows, None, layout.width)
    if count < len(base):
        raise ValueError(f"rows: expected one for each of {len(base)} cells, got {count}")
    check_shape("output", output, count, pixels * (3 + layout.history))
    if (matrix is None) == layout.surface:
        raise ValueError("matrix: expected one with layout.surface, None without")
    if matrix is not None:
        check_shape("matrix", matrix, count, 3 * (layout.channels + 1))
    kernel = implementation(__name__, backend, base.device)
    with torch.autocast(base.device.type, enabled=False):
        return kernel.depth_to_space(base, rows, output, matrix, layout)


def _tent(scale: int) -> Tensor:
    """[s, 3] weights of the samples at -1, 0, 1 for the s pixels between -1/2 and 1/2."""
    place = (torch.arange(scale) + 0.5) / scale - 0.5
    return (1 - (place[:, None] - torch.tensor((-1.0, 0.0, 1.0))).abs()).clamp(min=0)

"""The part of a picture that a frame computes: in each band of rows, the columns near matter."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor


@dataclass(frozen=True)
class Spans:
    """In each band of `unit` rows, the columns from the first to before the second of `columns`
    [bands, 2] int64, which are in units as well. A unit is a multiple of 4 pixels.

    Operations that take spans read pixels outside them as 0, and leave those of their result
    undefined.
    """

    columns: Tensor
    unit: int

    def at(self, size: int) -> Spans:
        """The same of a picture that is 1 / `size` as wide and high."""
        return replace(self, unit=self.unit // size)

    def mask(self, height: int, width: int) -> Tensor:
        """Which pixels of a picture are computed, [height, width] bool."""
        first, end = ends(self, height, width).unbind(1)
        column = torch.arange(width, device=first.device)
        return (column >= first[:, None]) & (column < end[:, None])

    def count(self, height: int, width: int) -> int:
        """How many pixels of a picture are computed."""
        return int(ends(self, height, width).diff(dim=1).clamp(min=0).sum())


def ends(spans: Spans | None, height: int, width: int) -> Tensor:
    """Of each row of a picture, the first pixel that is computed and the one after the last,
    [height, 2] int64; of all pixels without `spans`. ValueError if these have too few bands."""
    if spans is None:
        return torch.tensor([[0, width]]).expand(height, 2)
    bands, unit = len(spans.columns), spans.unit
    if unit % 4 or bands * unit < height:
        raise ValueError(
            f"spans: expected a unit of a multiple of 4 pixels, and bands of {height} "
            f"rows in all, got {bands} of {unit}"
        )
    return (unit * spans.columns).clamp(max=width).repeat_interleave(unit, 0)[:height]

"""The part of a picture that a frame computes: in each band of rows, the columns near matter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

RIM = 4  # pixels at the border of what is computed, where a network reads zeros beyond


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


def inside(spans: Spans | None, height: int, width: int, edges: Sequence[bool]) -> Spans:
    """What is computed of a part of a picture, [height, width], without its `RIM` at the border.

    `edges` says whether the picture ends at the top, bottom, left, right of the part: nothing is
    missing there, so that this is no border. Otherwise its sides are multiples of `RIM`.
    """
    top, bottom, left, right = edges
    across = -(-width // RIM)
    first, end = (-(-ends(spans, height, width)[::RIM] // RIM)).unbind(1)
    first = first + ((first > 0) | (not left)).long()
    end = end - ((end < across) | (not right)).long()
    rows, beyond = torch.stack((first, end), 1), torch.tensor([[across, 0]])
    above, below = rows[:1] if top else beyond, rows[-1:] if bottom else beyond
    first, end = torch.cat((above, rows, below)).unfold(0, 3, 1).unbind(1)  # of three rows each
    return Spans(torch.stack((first.amax(1), end.amin(1)), 1), RIM)

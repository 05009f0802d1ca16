"""Which points a caster may keep from the light, without asking each of them."""

from __future__ import annotations

import math
from collections.abc import Sequence

from torch import Tensor

TILES = 32  # into which the light's view of the points is divided, each way


class Tiles:
    """Points [N, 3] seen from the light, sorted by tiles: a caster needs only those under it."""

    def __init__(self, seen: Tensor) -> None:
        """`seen` are two coordinates across the light, and one that grows towards it."""
        self.low, self.high = seen.amin(0).cpu(), seen.amax(0).cpu()
        self.size = ((self.high - self.low)[:2] / TILES).clamp(min=1e-6)
        tile = ((seen - self.low.to(seen))[:, :2] / self.size.to(seen)).long().clamp(0, TILES - 1)
        number = tile[:, 0] * TILES + tile[:, 1]
        self.order = number.argsort()
        counts = number.bincount(minlength=TILES * TILES)
        self.starts = [0, *counts.cumsum(0).tolist()]
        farthest = seen.new_full((TILES * TILES,), math.inf)
        self.farthest = farthest.scatter_reduce(0, number, seen[:, 2], "amin").tolist()

    def casters(self, low: Tensor, high: Tensor) -> list[int]:
        """Which of the boxes from `low` to `high` [P, 3] may lie between a point and the light."""
        candidates = (low <= self.high)[:, :2].all(1) & (high >= self.low).all(1)
        return candidates.nonzero()[:, 0].tolist()

    def runs(self, low: Tensor, high: Tensor) -> list[slice]:
        """The sorted points in the tiles that a box [3] covers, unless all are nearer than it."""
        first, last = (self._tile(corner) for corner in (low, high))
        nearest = high[2].item()
        runs: list[slice] = []
        for row in range(first[0], last[0] + 1):
            for tile in range(row * TILES + first[1], row * TILES + last[1] + 1):
                if self.farthest[tile] > nearest:  # so is the tile of no points
                    continue
                start, end = self.starts[tile], self.starts[tile + 1]
                if runs and runs[-1].stop == start:
                    runs[-1] = slice(runs[-1].start, end)
                else:
                    runs.append(slice(start, end))
        return runs

    def _tile(self, corner: Tensor) -> Sequence[int]:
        """The column and the row of the tile nearest to a point."""
        place = ((corner - self.low)[:2] / self.size).floor()
        return place.clamp(0, TILES - 1).int().tolist()

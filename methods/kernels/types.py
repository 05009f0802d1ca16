"""What rays, samples and pixels are: the nouns that kernels and methods pass around.

An `Occupancy` says where samples may lie, `Samples` are `Intervals` on rays with positions, and
`Pixels` are what becomes of them.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar, Self

import torch
from scipy.ndimage import distance_transform_cdt
from torch import Tensor
from torch.nn import functional

from bench.types import Rays, SomeTensors, ThreeTensors, check_shape, rows

BRICK = 4  # cells along the side of a brick; its 64 cells are one word of `Occupancy.words`

LARGEST_SIDE = 1008  # most cells along a side of a grid: a byte holds its clearances, in bricks

PARALLEL = 2.0**-127
"""A smaller component of a direction counts as 0, because its reciprocal overflows float32."""


def expect(holds: bool, name: str, expected: str, got: object) -> None:
    """Raise ValueError with the `name` of a setting, and what is expected, unless that `holds`."""
    if not holds:
        raise ValueError(f"{name}: expected {expected}, got {got}")


def check_rays(rays: Rays) -> int:
    """The number of rays; raise ValueError if their shapes do not fit."""
    count = len(rays.origins)
    check_shape("origins", rays.origins, None, 3)
    check_shape("directions", rays.directions, count, 3)
    return count


class Occupancy:
    """Which cells of the unit cube may hold matter. `cells` [G, G, G] bool is indexed (x, y, z); G
    is a multiple of 16, at most `LARGEST_SIDE`. If `contracted`, all of space is in the cube, as
    `march.contraction` says. The derived properties let a ray cross all space known to be empty
    around it in one step."""

    def __init__(self, cells: Tensor, contracted: bool = False) -> None:
        size = cells.shape[0]
        check_shape("cells", cells, size, size, size)
        sides = f"a side that is a multiple of 16, at most {LARGEST_SIDE}"
        expect(not size % BRICK**2 and size <= LARGEST_SIDE, "cells", sides, size)
        self.cells, self.contracted = cells.bool(), contracted

    @classmethod
    def at(cls, coordinates: Tensor, resolution: int, contracted: bool = False) -> Occupancy:
        """A grid of `resolution`^3 cells in which those at `coordinates` [V, 3] are occupied."""
        cells = torch.zeros([resolution] * 3, dtype=torch.bool, device=coordinates.device)
        cells[coordinates.long().unbind(dim=1)] = True
        return cls(cells, contracted)

    def everywhere(self) -> Occupancy:
        """The grid of the same space in which every cell is occupied."""
        return Occupancy(torch.ones_like(self.cells), self.contracted)

    @property
    def resolution(self) -> int:
        """Cells along a side."""
        return self.cells.shape[0]

    def holds(self, positions: Tensor) -> Tensor:
        """Whether the cells of `positions` [..., 3] are occupied: [...] bool. Positions outside the
        unit cube belong to the nearest cell."""
        size = self.resolution
        return self.cells[(positions * size).long().clamp(0, size - 1).unbind(dim=-1)]

    @cached_property
    def words(self) -> Tensor:
        """A word per brick, [G/4, G/4, G/4] int64. Bit x + 4 y + 16 z is the cell (x, y, z)."""
        side = self.resolution // BRICK
        cells = self.cells.view(torch.uint8).view(side, BRICK, side, BRICK, side, BRICK)
        cells = cells.permute(0, 2, 4, 5, 3, 1).reshape(side, side, side, 8, 8)  # bits of 8 bytes
        weight = 1 << torch.arange(8, dtype=torch.uint8, device=cells.device)
        return (cells * weight).sum(dim=-1, dtype=torch.uint8).view(torch.int64).squeeze(-1)

    @cached_property
    def bricks(self) -> Tensor:
        """Coordinates of the non-empty bricks, in bricks: [B, 3]."""
        return self.words.nonzero()

    @cached_property
    def clearance(self) -> Tensor:
        """`clearance` of the bricks that are not empty: [G/4, G/4, G/4]."""
        return clearance(self.words != 0)

    @cached_property
    def bounds(self) -> Tensor:
        """Corners of the box around all occupied cells, [2, 3]; empty (lower > upper) if none."""
        size = self.resolution
        lower, upper = torch.ones(3), torch.zeros(3)
        for axis in range(3):
            filled = self.cells.any(dim=[a for a in range(3) if a != axis]).nonzero()
            if len(filled):
                lower[axis], upper[axis] = filled[0] / size, (filled[-1] + 1) / size
        return torch.stack((lower, upper))


def clearance(used: Tensor) -> Tensor:
    """Chebyshev distance [S, S, S] uint8 of each brick to the nearest `used` one [S, S, S], S if
    there is none; at most 255. The host waits for a GPU."""
    apart = torch.from_numpy(distance_transform_cdt(~used.cpu().numpy(), "chessboard"))
    return apart.where(apart >= 0, len(used)).clamp(max=255).to(used.device, torch.uint8)


def cat(parts: SomeTensors) -> Tensor:
    """`torch.cat` of one or more tensors; a single one is not copied."""
    return parts[0] if len(parts) == 1 else torch.cat(tuple(parts))


def joined(parts: Iterable[SomeTensors]) -> tuple[Tensor, ...]:
    """The first tensors of all `parts` as one, see `cat`; the second ones; and so on."""
    return tuple(map(cat, zip(*parts, strict=True)))


def total_and_longest(counts: Tensor, offsets: Tensor) -> list[int]:
    """How many samples rays with `counts` [R] have, and how many the one with the most; `offsets`
    are `offsets_of` the counts. The host waits for a GPU, once."""
    return torch.stack((offsets[-1], counts.amax())).tolist() if len(counts) else [0, 0]


def offsets_of(counts: Tensor) -> Tensor:
    """Where each ray's samples begin [R + 1], given its `counts` [R]; the last one is the end."""
    return functional.pad(counts.cumsum(dim=0), (1, 0))


@dataclass(frozen=True)
class Intervals:
    """The positions of samples on R rays, ray by ray, front to back."""

    t: Tensor  # [S] position along the ray (z-depth for rays of `bench.cameras.cast`)
    delta: Tensor  # [S] length of the interval a sample represents, scene units
    offsets: Tensor  # [R + 1] int64, ray r owns samples offsets[r] to offsets[r + 1]
    # Samples of the ray that has the most, or more than that; None: unknown, as `offsets` say.
    longest: int | None = field(default=None, kw_only=True)
    of_a_sample: ClassVar[Sequence[str]] = "t", "delta"  # what has a row for each sample

    def __len__(self) -> int:
        return len(self.t)

    def front(self, counts: Tensor) -> Self:
        """Only the first `counts` [R] samples of each ray. The host waits for a GPU."""
        offsets = offsets_of(counts)
        total, longest = total_and_longest(counts, offsets)
        shift = (self.offsets - offsets)[:-1].repeat_interleave(counts, output_size=total)
        index = torch.arange(total, device=shift.device) + shift
        return self.chosen(index, offsets, longest)

    def chosen(self, index: Tensor, offsets: Tensor, longest: int | None) -> Self:
        """Only the samples at `index` [N], which lie on the rays as `offsets` [R + 1] say."""
        # A row at a time; `x[index]` goes number by number.
        columns = {name: getattr(self, name) for name in self.of_a_sample}
        some = {name: x.index_select(0, index) for name, x in columns.items() if x is not None}
        return replace(self, **some, offsets=offsets, longest=longest)


@dataclass(frozen=True)
class Samples(Intervals):
    """Samples of R rays, ray by ray, front to back."""

    ray: Tensor  # [S] int32, the ray that a sample belongs to
    positions: Tensor  # [S, 3] in the unit cube
    resume: Tensor  # [R] int32, the step to resume from; -1 if the ray has no more samples
    encoded: Tensor | None = field(default=None, kw_only=True)  # [S, E] positions, by a field
    of_a_sample: ClassVar[Sequence[str]] = "t", "delta", "ray", "positions", "encoded"

    def chosen(self, index: Tensor, offsets: Tensor, longest: int | None) -> Self:
        """As of `Intervals`, with no more to follow."""
        some = super().chosen(index, offsets, longest)
        return replace(some, resume=torch.full_like(self.resume, -1))


@dataclass(frozen=True)
class Pixels:
    """Composited rays: `values` [R, K], `depth_sum` [R] (sum w t, not divided), `alpha` [R]."""

    values: Tensor
    depth_sum: Tensor
    alpha: Tensor

    @classmethod
    def blank(cls, rays: int, channels: int, device: torch.device | str = "cpu") -> Pixels:
        """Rays before any sample is composited: all zeros."""
        shapes = (rays, channels), (rays,), (rays,)
        return cls(*(torch.zeros(shape, device=device) for shape in shapes))

    def take(self, index: Tensor | slice) -> Pixels:
        """The rays at `index`."""
        return Pixels(*(rows(x, index) for x in self.columns))

    def copy(self) -> Pixels:
        """Contiguous tensors of their own."""
        return Pixels(*(x.clone(memory_format=torch.contiguous_format) for x in self.columns))

    def put(self, index: Tensor, pixels: Pixels) -> None:
        """Replace, in place, the rays at `index`."""
        for column, new in zip(self.columns, pixels.columns, strict=True):
            column.index_copy_(0, index, new)  # a row at a time; `x[index]` goes number by number

    @property
    def columns(self) -> ThreeTensors:
        """Values, depth sums and opacities."""
        return self.values, self.depth_sum, self.alpha

    def over(self, background: Tensor) -> Pixels:
        """Composite the rays onto a `background` [K] or [R, K], whose weight is 1 - alpha."""
        shine = (1 - self.alpha)[:, None] * background
        return Pixels(self.values + shine, self.depth_sum, self.alpha)


Composited = tuple[Pixels, int]  # and of how many samples

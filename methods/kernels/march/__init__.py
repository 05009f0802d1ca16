"""Ray marching through an occupancy grid: samples only in cells that may hold matter.

A ray enters the unit cube at t_0 and is divided into steps of equal world length:
t_k = t_0 + (k + phase) step / norm(d), with phase 1/2 (midpoint rule) or a jitter in [0, 1).
Sample k exists if the cell at o + t_k d is occupied and t_k is in the ray's window. The set of
samples does not depend on how empty space is skipped, so that all backends return the same samples;
a window removes samples but moves none.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property

import torch
from torch import Tensor
from torch.nn import functional

from bench.types import Rays, check_shape
from methods.kernels.composite import Extent, Intervals
from methods.kernels.dispatch import implementation

MAX_SAMPLES = 1024
"""Most samples of a ray through the unit cube at the usual step, sqrt(3) / 1024."""

PARALLEL = 2.0**-127
"""A smaller component of a direction counts as 0, because its reciprocal overflows float32."""

BRICK = 4
"""Cells along the side of a brick; its 64 cells are one word of `Occupancy.words`."""


class Occupancy:
    """Which cells of the unit cube may hold matter.

    `cells` [G, G, G] bool is indexed (x, y, z); G is a multiple of 16. The derived properties let a
    ray cross all space known to be empty around it in one step.
    """

    def __init__(self, cells: Tensor) -> None:
        size = cells.shape[0]
        check_shape("cells", cells, size, size, size)
        if size % BRICK**2:
            raise ValueError(f"cells: expected a side that is a multiple of 16, got {size}")
        self.cells = cells.bool()

    @classmethod
    def at(cls, coordinates: Tensor, resolution: int) -> Occupancy:
        """A grid of `resolution`^3 cells in which those at `coordinates` [V, 3] are occupied."""
        cells = torch.zeros([resolution] * 3, dtype=torch.bool, device=coordinates.device)
        cells[coordinates.long().unbind(dim=1)] = True
        return cls(cells)

    @property
    def resolution(self) -> int:
        """Cells along a side."""
        return self.cells.shape[0]

    def holds(self, positions: Tensor) -> Tensor:
        """Whether the cells of `positions` [..., 3] are occupied: [...] bool.

        Positions outside the unit cube belong to the nearest cell.
        """
        size = self.resolution
        return self.cells[(positions * size).long().clamp(0, size - 1).unbind(dim=-1)]

    @cached_property
    def words(self) -> Tensor:
        """One bit per cell, one int64 word per brick: [G/4, G/4, G/4]."""
        return _pack_bricks(self.cells)

    @cached_property
    def bricks(self) -> Tensor:
        """Coordinates of the non-empty bricks, in bricks: [B, 3]."""
        return self.words.nonzero()

    @cached_property
    def clearance(self) -> Tensor:
        """Chebyshev distance in bricks to the nearest non-empty brick: [G/4, G/4, G/4] uint8.

        0 in a non-empty brick, at most G/4.
        """
        side = self.resolution // BRICK
        index = torch.arange(side, dtype=torch.uint8, device=self.cells.device)
        apart = torch.where(index > index[:, None], index - index[:, None], index[:, None] - index)
        distance = torch.where(self.words != 0, 0, side).to(torch.uint8)
        # The largest of the distances along the axes: its minimum is taken axis by axis.
        for _ in range(3):
            distance = torch.maximum(distance[:, None], apart[:, :, None, None]).amin(dim=0)
            distance = distance.permute(1, 2, 0)
        return distance.contiguous()

    @cached_property
    def bounds(self) -> Tensor:
        """Corners of the box around all occupied cells, [2, 3]; empty (lower > upper) if none."""
        size = self.resolution
        lower, upper = torch.ones(3), torch.zeros(3)
        for axis in range(3):
            other = [a for a in range(3) if a != axis]
            filled = self.cells.any(dim=other[1]).any(dim=other[0]).nonzero()
            if len(filled):
                lower[axis], upper[axis] = filled[0] / size, (filled[-1] + 1) / size
        return torch.stack((lower, upper))


def _pack_bricks(bits: Tensor) -> Tensor:
    """Pack cells into 64-bit words: bit x + 4 y + 16 z is the cell (x, y, z) of a 4^3 brick."""
    side = bits.shape[0] // BRICK
    cells = bits.view(torch.uint8).view(side, BRICK, side, BRICK, side, BRICK)
    cells = cells.permute(0, 2, 4, 5, 3, 1).reshape(side, side, side, 8, 8)  # 8 bytes of 8 bits
    weight = 1 << torch.arange(8, dtype=torch.uint8, device=bits.device)
    return (cells * weight).sum(dim=-1, dtype=torch.uint8).view(torch.int64).squeeze(-1)


@dataclass(frozen=True)
class Samples(Intervals):
    """Samples of R rays, ray by ray, front to back.

    Attributes:
        ray: [S] int32, the ray that a sample belongs to.
        positions: [S, 3] in the unit cube.
        resume: [R] int32, the step to resume from; -1 if the ray has no more samples.
        encoded: [S, E] encoding of the positions by a field; None: unknown.
    """

    ray: Tensor
    positions: Tensor
    resume: Tensor
    encoded: Tensor | None = field(default=None, kw_only=True)

    def __len__(self) -> int:
        return len(self.t)

    def front(self, counts: Tensor, extent: Extent | None = None) -> Samples:
        """Only the first `counts` [R] samples of each ray, with no more to follow.

        `extent` is as for `first_of_each`.
        """
        return self.chosen(*self.first_of_each(counts, extent))

    def chosen(self, index: Tensor, offsets: Tensor, longest: int | None) -> Samples:
        """Only the samples at `index` [N], which lie on the rays as `offsets` [R + 1] say, with no
        more to follow. `longest` is as for `Intervals`."""
        # A row at a time; `x[index]` goes number by number.
        columns = self.t, self.delta, self.ray, self.positions
        t, delta, ray, positions = (column.index_select(0, index) for column in columns)
        encoded = None if self.encoded is None else self.encoded.index_select(0, index)
        resume = torch.full_like(self.resume, -1)
        return Samples(t, delta, offsets, ray, positions, resume, longest=longest, encoded=encoded)


@dataclass(frozen=True)
class Segments:
    """The parts of R rays to sample; see `march`.

    Attributes:
        rays: the R rays.
        window: [R, 2] nearest and farthest t, the latter excluded.
        jitter: [R] phase of the samples.
        start: [R] int32 first step; negative: no samples.
    """

    rays: Rays
    window: Tensor
    jitter: Tensor
    start: Tensor


def march(
    rays: Rays,
    occupancy: Occupancy,
    step: float,
    *,
    window: Tensor | None = None,
    jitter: Tensor | None = None,
    start: Tensor | None = None,
    limit: int | None = None,
    extent: Extent | None = None,
    backend: str = "auto",
) -> Samples:
    """Sample R `rays` inside the unit cube. Not differentiable.

    A ray has no samples if it misses the cube, is not finite, or has a direction that is zero or so
    short that t overflows.

    Args:
        step: world length of a step, scene units.
        window: [R, 2] nearest and farthest t, the latter excluded; None: [0, inf).
        jitter: [R] phase of a ray's samples in [0, 1); None: 1/2.
        start: [R] int32 first step, from `Samples.resume` of an earlier call with the same rays;
            negative: no samples; None: 0.
        limit: maximum number of samples per ray; None: all.
        extent: how many samples there are, from `extents` or `sample_counts`; with it, the host
            does not wait for a GPU.
    """
    segments = _segments(rays, step, window, jitter, start)
    if limit is None:
        limit = longest_ray(step)
    if limit < 1:
        raise ValueError(f"limit: expected 1 or more, got {limit}")
    kernel = implementation(__name__, backend, rays.origins.device)
    return kernel.march(segments, occupancy, step, limit, extent)


def extents(
    rays: Rays,
    occupancy: Occupancy,
    step: float,
    size: int,
    *,
    window: Tensor | None = None,
    backend: str = "auto",
) -> list[Extent]:
    """How many samples `march` finds in each batch of `size` rays, in order.

    The host waits for a GPU, once.
    """
    counts = sample_counts(rays, occupancy, step, window=window, backend=backend)
    return Extent.of_each(functional.pad(counts, (0, -len(counts) % size)).view(-1, size))


def sample_counts(
    rays: Rays,
    occupancy: Occupancy,
    step: float,
    *,
    window: Tensor | None = None,
    jitter: Tensor | None = None,
    start: Tensor | None = None,
    backend: str = "auto",
) -> Tensor:
    """How many samples `march` finds for each of R `rays`: [R] int64."""
    segments = _segments(rays, step, window, jitter, start)
    kernel = implementation(__name__, backend, rays.origins.device)
    counts: Tensor = kernel.count(segments, occupancy, step)
    return counts


def longest_ray(step: float) -> int:
    """Upper bound on the samples of a ray: those on the cube's diagonal, plus some for rounding."""
    return math.ceil(math.sqrt(3) / step) + 1


def _segments(
    rays: Rays, step: float, window: Tensor | None, jitter: Tensor | None, start: Tensor | None
) -> Segments:
    """Check the arguments of `march` and fill in defaults."""
    origins, count = rays.origins, len(rays.origins)
    check_shape("origins", origins, None, 3)
    check_shape("directions", rays.directions, count, 3)
    if window is None:
        ends = origins.new_zeros(()), origins.new_full((), torch.inf)
        window = torch.stack(ends).expand(count, 2)
    if jitter is None:
        jitter = origins.new_full((1,), 0.5).expand(count)
    if start is None:
        start = torch.zeros(1, dtype=torch.int32, device=origins.device).expand(count)
    check_shape("window", window, count, 2)
    check_shape("jitter", jitter, count)
    check_shape("start", start, count)
    if not step > 0:
        raise ValueError(f"step: expected a positive length, got {step}")
    return Segments(rays, window, jitter, start)

"""Volume rendering of samples into pixels (Max 1995; SteerNeRF Eq. 2 and 3).

alpha_i = 1 - exp(-sigma_i delta_i),  T_i = prod_{j<i} (1 - alpha_j),  w_i = T_i alpha_i
values = sum w_i f_i,  depth_sum = sum w_i t_i,  alpha = sum w_i
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor
from torch.nn import functional

from bench.types import check_shape
from methods.kernels.dispatch import implementation

STOP = 1e-4
"""Transmittance at which a ray ends: what lies behind changes a pixel by less than this."""


def check_stop(stop: float) -> None:
    """Raise ValueError unless 0 <= `stop` < 1; from 1 on, rays would end before they begin."""
    if not 0 <= stop < 1:
        raise ValueError(f"stop: expected a transmittance of 0 or more and less than 1, got {stop}")


@dataclass(frozen=True)
class Extent:
    """Sample counts of some rays, known to the host.

    Attributes:
        total: samples of all rays together.
        longest: samples of the ray that has the most.
    """

    total: int
    longest: int

    @classmethod
    def of_each(cls, counts: Tensor) -> list[Extent]:
        """The extent of each group of rays with `counts` [G, R] samples. Waits for a GPU, once."""
        return [cls(*size) for size in cls.figures(counts).tolist()]

    @staticmethod
    def figures(counts: Tensor) -> Tensor:
        """`total` and `longest` of each group of `counts` [G, R], on the same device: [G, 2]."""
        counts = functional.pad(counts, (0, 1))  # for a group without rays
        return torch.stack((counts.sum(dim=1), counts.amax(dim=1)), dim=1)


@dataclass(frozen=True)
class Intervals:
    """The positions of samples on R rays, ray by ray, front to back.

    Attributes:
        t: [S] position along the ray (z-depth for rays of `bench.cameras.cast`).
        delta: [S] length of the interval a sample represents, scene units.
        offsets: [R + 1] int64, ray r owns samples offsets[r] to offsets[r + 1].
        longest: samples of the ray that has the most, or more than that; None: unknown, it follows
            from `offsets`.
    """

    t: Tensor
    delta: Tensor
    offsets: Tensor
    longest: int | None = field(default=None, kw_only=True)

    def first_of_each(
        self, counts: Tensor, extent: Extent | None = None
    ) -> tuple[Tensor, Tensor, int]:
        """Indices of the first `counts` [R] samples of each ray, and their `offsets` and `longest`.

        `extent` is that of `counts`; if None, the host waits for a GPU.
        """
        if extent is None:
            (extent,) = Extent.of_each(counts[None])
        offsets = torch.cat((counts.new_zeros(1), counts.cumsum(dim=0)))
        shift = (self.offsets - offsets)[:-1].repeat_interleave(counts, output_size=extent.total)
        return torch.arange(extent.total, device=shift.device) + shift, offsets, extent.longest


@dataclass(frozen=True)
class Pixels:
    """Composited rays: `values` [R, K], `depth_sum` [R] (sum w t, not divided), `alpha` [R]."""

    values: Tensor
    depth_sum: Tensor
    alpha: Tensor

    @classmethod
    def blank(cls, rays: int, channels: int, device: torch.device | str = "cpu") -> Pixels:
        """Rays before any sample is composited: all zeros."""
        return cls(
            torch.zeros(rays, channels, device=device),
            torch.zeros(rays, device=device),
            torch.zeros(rays, device=device),
        )

    def take(self, index: Tensor | slice) -> Pixels:
        """The rays at `index`."""
        if isinstance(index, slice):
            return Pixels(*(x[index] for x in self._columns))
        return Pixels(*(x.index_select(0, index) for x in self._columns))

    def put(self, index: Tensor | slice, pixels: Pixels) -> None:
        """Replace, in place, the rays at `index`."""
        for column, new in zip(self._columns, pixels._columns, strict=True):
            if isinstance(index, slice):
                column[index] = new
            else:  # a row at a time; `x[index]` goes number by number
                column.index_copy_(0, index, new)

    @property
    def _columns(self) -> tuple[Tensor, Tensor, Tensor]:
        return self.values, self.depth_sum, self.alpha

    def over(self, background: Tensor) -> Pixels:
        """Composite the rays onto a `background` [K] or [R, K], whose weight is 1 - alpha."""
        shine = (1 - self.alpha)[:, None] * background
        return Pixels(self.values + shine, self.depth_sum, self.alpha)


def composite(
    sigma: Tensor,
    values: Tensor,
    intervals: Intervals,
    *,
    stop: float = STOP,
    carry: Pixels | None = None,
    backend: str = "auto",
) -> Pixels:
    """Composite the samples of R rays.

    Differentiable in `sigma` and `values`.

    Args:
        sigma: [S] density, not negative.
        values: [S, K] colour or features.
        intervals: positions of the samples, for example `march.Samples`.
        stop: samples behind a transmittance of at most `stop` have no weight; 0 uses all.
        carry: pixels of the samples in front of these, as a constant without gradient.
    """
    _check_samples(sigma, intervals)
    check_shape("values", values, len(sigma), None)
    check_shape("t", intervals.t, len(sigma))
    if carry is not None:
        rays, channels = len(intervals.offsets) - 1, values.shape[1]
        check_shape("carry.values", carry.values, rays, channels)
        check_shape("carry.depth_sum", carry.depth_sum, rays)
        check_shape("carry.alpha", carry.alpha, rays)
    return implementation(__name__, backend, sigma.device).composite(
        sigma, values, intervals, stop, carry
    )


def weights(
    sigma: Tensor,
    intervals: Intervals,
    *,
    stop: float = STOP,
    front: Tensor | None = None,
    backend: str = "auto",
) -> Tensor:
    """The weights [S] that `composite` gives to samples, computed without values. No gradient.

    Args:
        front: [R] transmittance in front of each ray's first sample; None: 1.
    """
    front = _light(sigma, intervals, front)
    return implementation(__name__, backend, sigma.device).weights(
        sigma.detach(), intervals, stop, front
    )


def visible(
    sigma: Tensor,
    intervals: Intervals,
    *,
    stop: float = STOP,
    front: Tensor | None = None,
    backend: str = "auto",
) -> tuple[Tensor, Tensor]:
    """How many samples of each ray get a weight from `composite`, [R] int64, and the transmittance
    behind them, [R]. No gradient.

    They are the first samples of the ray; those behind have neither weight nor gradient.

    Args:
        front: [R] transmittance in front of each ray's first sample; None: 1.
    """
    front = _light(sigma, intervals, front)
    return implementation(__name__, backend, sigma.device).visible(
        sigma.detach(), intervals, stop, front
    )


def _light(sigma: Tensor, intervals: Intervals, front: Tensor | None) -> Tensor:
    """Check the samples, and the transmittance in `front` of each ray or its default."""
    _check_samples(sigma, intervals)
    rays = len(intervals.offsets) - 1
    if front is None:
        front = sigma.new_ones(rays)
    check_shape("front", front, rays)
    return front


def _check_samples(sigma: Tensor, intervals: Intervals) -> None:
    offsets = intervals.offsets
    check_shape("sigma", sigma, None)
    check_shape("delta", intervals.delta, len(sigma))
    check_shape("offsets", offsets, None)
    # Not checked on a GPU, for which the host would have to wait.
    if len(offsets) < 1 or (offsets.device.type == "cpu" and int(offsets[-1]) != len(sigma)):
        raise ValueError(f"offsets: expected to end at the {len(sigma)} samples, got {offsets}")

"""Volume rendering of samples into pixels (Max 1995; SteerNeRF Eq. 2 and 3).

alpha_i = 1 - exp(-sigma_i delta_i),  T_i = prod_{j<i} (1 - alpha_j),  w_i = T_i alpha_i
values = sum w_i f_i,  depth_sum = sum w_i t_i,  alpha = sum w_i
"""

from typing import NamedTuple

from torch import Tensor

from bench.types import check_shape
from methods.kernels.dispatch import implementation
from methods.kernels.types import Intervals, Pixels

STOP = 1e-4  # transmittance at which a ray ends: what lies behind changes a pixel by less than this


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
        intervals: positions of the samples, for example `Samples`.
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
    kernel = implementation(__name__, backend, sigma.device)
    return kernel.composite(sigma, values, intervals, stop, carry)


class Visibility(NamedTuple):
    """What `composite` sees of samples, computed without values. No gradient."""

    weights: Tensor  # [S]
    # [R] int64, how many samples of a ray get a weight. They are its first ones; those behind have
    # neither weight nor gradient.
    counts: Tensor
    left: Tensor  # [R] transmittance behind them


def visibility(
    sigma: Tensor,
    intervals: Intervals,
    *,
    stop: float = STOP,
    front: Tensor | None = None,
    backend: str = "auto",
) -> Visibility:
    """The visibility of samples as for `composite`. `front` [R] is the transmittance in front of
    each ray's first sample; None: 1."""
    _check_samples(sigma, intervals)
    rays = len(intervals.offsets) - 1
    front = sigma.new_ones(rays) if front is None else front
    check_shape("front", front, rays)
    kernel = implementation(__name__, backend, sigma.device)
    return Visibility(*kernel.visibility(sigma.detach(), intervals, stop, front))


def _check_samples(sigma: Tensor, intervals: Intervals) -> None:
    offsets = intervals.offsets
    check_shape("sigma", sigma, None)
    check_shape("delta", intervals.delta, len(sigma))
    check_shape("offsets", offsets, None)
    # Not checked on a GPU, for which the host would have to wait.
    if len(offsets) < 1 or (offsets.device.type == "cpu" and int(offsets[-1]) != len(sigma)):
        raise ValueError(f"offsets: expected to end at the {len(sigma)} samples, got {offsets}")

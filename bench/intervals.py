"""95 % intervals of means: over independent repetitions, and over the frames of a path."""

from __future__ import annotations

import math

import numpy as np
from scipy import fft, special

CONFIDENCE = 0.95


def half_interval(values: np.ndarray) -> float:
    """Half of the t-interval of the mean of independent `values` [n]; nan for fewer than two, or
    where one is not finite."""
    if len(values) < 2 or not np.isfinite(values).all():
        return math.nan
    return _quantile(len(values) - 1) * values.std(ddof=1) / math.sqrt(len(values))


def path_interval(values: np.ndarray) -> float:
    """Half of the interval of the mean of `values` [n], one a frame, in the order of their path;
    nan for fewer than two, or where one is not finite.

    Neighbouring frames are alike, so n of them say less than n independent ones. The slow part of
    their variation says how uncertain the mean is: the first B coefficients of the orthonormal
    cosine transform, B = 0.4 n^(2/3) rounded up, each with a variance near n times that of the
    mean, and nearly independent. So their mean square gives a t-interval with B degrees of freedom
    (Lazarus et al. 2018, "HAR Inference: Recommendations for Practice"). With all n - 1
    coefficients it would be `half_interval`.

    A block bootstrap needs more frames than a path has: of autocorrelated series as short as ours
    it covered the mean less often (docs/log.md).
    """
    if len(values) < 2 or not np.isfinite(values).all():
        return math.nan
    count = math.ceil(0.4 * len(values) ** (2 / 3))
    slow = fft.dct(values - values.mean(), norm="ortho")[1 : count + 1]
    return _quantile(count) * math.sqrt((slow**2).mean() / len(values))


def _quantile(freedom: int) -> float:
    """Of Student's t: the half-width, in standard errors, of an interval with `CONFIDENCE`."""
    return float(special.stdtrit(freedom, 0.5 + CONFIDENCE / 2))

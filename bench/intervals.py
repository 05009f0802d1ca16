"""95 % intervals of means: over independent repetitions, and over the frames of a path."""

from __future__ import annotations

import math

import numpy as np
from scipy import fft, special

CONFIDENCE = 0.95


def half_interval(values: np.ndarray) -> float:
    """Half the t-interval of the mean of independent `values`; nan for < 2 or not finite ones."""
    if len(values) < 2 or not np.isfinite(values).all():
        return math.nan
    return _quantile(len(values) - 1) * values.std(ddof=1) / math.sqrt(len(values))


def path_interval(values: np.ndarray) -> float:
    """Half the width of the interval of the mean of `values` [n], one per frame, in path order.

    nan for fewer than two values, or if one is not finite.

    Neighbouring frames are alike, so n frames say less than n independent values. How uncertain the
    mean is follows from the slow part of the variation: the first B coefficients of the orthonormal
    cosine transform, B = 0.4 n^(2/3) rounded up. They are nearly independent, each with a variance
    near n times that of the mean, so their mean square gives a t-interval with B degrees of freedom
    (Lazarus et al. 2018, "HAR Inference: Recommendations for Practice"). All n - 1 coefficients
    would give `half_interval`. A block bootstrap needs more frames than a path has (docs/log.md).
    """
    if len(values) < 2 or not np.isfinite(values).all():
        return math.nan
    count = math.ceil(0.4 * len(values) ** (2 / 3))
    slow = fft.dct(values - values.mean(), norm="ortho")[1 : count + 1]
    return _quantile(count) * math.sqrt((slow**2).mean() / len(values))


def _quantile(freedom: int) -> float:
    """Quantile of Student's t: half-width, in standard errors, of an interval at `CONFIDENCE`."""
    return float(special.stdtrit(freedom, 0.5 + CONFIDENCE / 2))

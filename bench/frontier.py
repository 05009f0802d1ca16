"""The Pareto frontier of settings that trade time for error."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def best_instead(cost: Sequence[float], error: Sequence[float]) -> list[int]:
    """For each setting, the index of the best setting that costs no more.

    Best is the least `error`, then the least `cost`, then the lowest index. A setting on the Pareto
    frontier gets its own index (among duplicates, only the first does); any other setting gets the
    index of one that dominates it.
    """
    costs, errors = np.asarray(cost, float), np.asarray(error, float)
    best: list[int] = [0] * len(costs)
    least = -1
    for index in np.lexsort((errors, costs)):  # the cheapest first; lexsort keeps the order of ties
        if least < 0 or errors[index] < errors[least]:
            least = int(index)
        best[index] = least
    return best


def cheapest_within(cost: Sequence[float], error: Sequence[float], limit: float) -> int | None:
    """The index of the cheapest setting whose error is at most `limit`; None if there is none."""
    allowed = [index for index, size in enumerate(error) if size <= limit]
    return min(allowed, key=lambda index: (cost[index], error[index]), default=None)


def observed_order(knob: Sequence[float], error: Sequence[float]) -> float:
    """Fit the power law error = c knob^p and return p, by least squares on the logarithms.

    `knob` and `error` hold at least two values, all positive.
    """
    slope, _ = np.polyfit(np.log(knob), np.log(error), 1)
    return float(slope)

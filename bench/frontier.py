"""The Pareto frontier of settings that trade time for error."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def best_instead(cost: Sequence[float], error: Sequence[float]) -> list[int]:
    """For each setting, the index of the one to use in its place: the least `error` among those
    that cost no more, of equals the cheapest, of equals the first.

    A setting on the Pareto frontier (of several alike there, the first) gets its own index; any
    other is dominated by the one at its index.
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
    """The index of the cheapest setting whose error is at most `limit`; None without one."""
    allowed = [index for index, size in enumerate(error) if size <= limit]
    return min(allowed, key=lambda index: (cost[index], error[index]), default=None)


def observed_order(knob: Sequence[float], error: Sequence[float]) -> float:
    """p of the power law error = c knob^p that fits best: the slope of the logarithms, by least
    squares. `knob` and `error` are positive, and two or more."""
    slope, _ = np.polyfit(np.log(knob), np.log(error), 1)
    return float(slope)

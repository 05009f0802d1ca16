"""Checks the paper's trends one by one: whether a metric grows here as it does there."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from bench.intervals import half_interval, path_interval
from reports.comparison import Write, metric_format
from reports.regression import LIMITS, Figures, frames_apart
from reports.runs import Repeated
from reports.tables import Table

HOLDS, FAILS, OPEN = "holds", "does not hold", "cannot be told"
SMALLER = "smaller than in the paper"
SEEN, REVERSED = "agrees, by one seed", "opposite, by one seed"
"""Verdicts from the frames of one seed; another training may reverse them."""


@dataclass(frozen=True)
class Trend:
    """A claim: `metric` grows along the lines with the labels `rising`."""

    metric: str
    rising: Sequence[str]


@dataclass(frozen=True)
class Difference:
    """The growth of a metric from one line of a trend to the next."""

    metric: str
    smaller: str
    larger: str
    paper: float  # in the paper; nan if it does not give both figures
    by: float  # the mean here, over what `over` says
    half: float  # half its 95 % interval; nan if unknown
    over: str
    proves: bool  # whether the interval accounts for differences between trainings

    @property
    def verdict(self) -> str:
        """Whether the metric grows here, shrinks, grows less than in the paper, or is undecided."""
        low, high = self.by - self.half, self.by + self.half
        if low > 0:
            return HOLDS if self.proves else SEEN
        if high <= 0:
            return FAILS if self.proves else REVERSED
        return SMALLER if self.proves and high < self.paper else OPEN


def differences(
    trend: Trend, lines: Mapping[str, Repeated], published: Mapping[str, Mapping[str, float]]
) -> Iterator[Difference]:
    """Every difference of `trend` between two measured `lines`; in the paper: `published`."""
    for smaller, larger in pairwise(trend.rising):
        one, other = lines.get(smaller), lines.get(larger)
        here = _growth(one, other, trend.metric) if one and other else None
        if here is not None:
            figures = (published.get(label, {}) for label in (smaller, larger))
            below, above = (figure.get(trend.metric, math.nan) for figure in figures)
            yield Difference(trend.metric, smaller, larger, above - below, *here)


def _growth(one: Repeated, other: Repeated, metric: str) -> tuple[float, float, str, bool] | None:
    """The last four fields of a `Difference`: the mean over pairs; None if there are no pairs.

    With several seeds, a pair has the same seed; with one seed, a pair is the same frame.
    """
    here = metric in LIMITS and LIMITS[metric].here
    pairs = [
        (run, twin)
        for run in one.runs
        for twin in other.runs
        if run.facts["seed"] == twin.facts["seed"]
        and metric in run.values
        and metric in twin.values
        and (not here or run.computer == twin.computer)
    ]
    if not pairs:
        return None
    by_seed = np.array([twin.values[metric] - run.values[metric] for run, twin in pairs])
    by = float(by_seed.mean())
    if metric.startswith("size_bytes"):
        return by, 0.0, "computed, not sampled", True
    if len(pairs) > 1:
        return by, half_interval(by_seed), f"{len(pairs)} seeds", True
    by_frame = frames_apart(metric, *map(Figures.of, pairs[0]))
    if len(by_frame) > 1:
        over = f"{len(by_frame)} frames of one seed"
        return float(by_frame.mean()), path_interval(by_frame), over, False
    return by, math.nan, "one figure each", False


def trend_table(differences: Sequence[Difference]) -> Table:
    """A table of `differences`, one line each."""
    lines = []
    for each in differences:
        label, write = metric_format(each.metric)
        half = f" ± {write(each.half)}" if each.half > 0 else ""
        name = f"{label.rstrip(' ↑↓')}: {each.smaller} < {each.larger}"
        paper = "" if math.isnan(each.paper) else signed(each.paper, write)
        lines.append((name, paper, signed(each.by, write) + half, each.over, each.verdict))
    columns = ("difference", "paper", "here", "over", "verdict")
    return Table("Trends", columns, tuple(lines))


def signed(by: float, write: Write) -> str:
    """A difference with its sign."""
    return ("-" if by < 0 else "+") + write(abs(by))

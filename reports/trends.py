"""Whether what the paper says becomes better, faster or smaller does so here: step by step."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from bench.run import half_interval
from reports.comparison import written
from reports.regression import LIMITS, Figures
from reports.seeds import Repeated
from reports.tables import Table

HOLDS, FAILS, OPEN = "holds", "does not hold", "cannot be told"
SEEN, REVERSED = "so, by one seed", "the reverse, by one seed"
"""What frames of one seed can say: another training may turn it around."""

COMPUTED = "computed, not sampled"


@dataclass(frozen=True)
class Trend:
    """`metric` grows along the lines `rising`, by their labels."""

    metric: str
    rising: Sequence[str]


@dataclass(frozen=True)
class Step:
    """From one line of a trend to the next.

    Attributes:
        by: what the metric grows by.
        half: half of the 95 % interval of that; nan where it is not known.
        over: of what the interval is.
        proves: whether the interval holds the difference between one training and the next.
    """

    metric: str
    smaller: str
    larger: str
    by: float
    half: float
    over: str
    proves: bool

    @property
    def verdict(self) -> str:
        """Whether it grows, does not, or neither can be told."""
        if self.by - self.half > 0:
            return HOLDS if self.proves else SEEN
        if self.by + self.half <= 0:
            return FAILS if self.proves else REVERSED
        return OPEN


def steps(trend: Trend, lines: Mapping[str, Repeated]) -> Iterator[Step]:
    """Every step of `trend` between two lines that were measured."""
    for smaller, larger in pairwise(trend.rising):
        one, other = lines.get(smaller), lines.get(larger)
        if one is not None and other is not None:
            apart, over, proves = _apart(one, other, trend.metric)
            if len(apart):
                half = half_interval(apart)
                if trend.metric.startswith("size_bytes"):
                    half, over, proves = 0.0, COMPUTED, True
                by = float(apart.mean())
                yield Step(trend.metric, smaller, larger, by, half, over, proves)


def _apart(one: Repeated, other: Repeated, metric: str) -> tuple[np.ndarray, str, bool]:
    """Differences of pairs, of the same seed where there are several, else of the same frame; of
    what; and whether of several trainings."""
    pairs = [
        (run, twin)
        for run in one.runs
        for twin in other.runs
        if run.facts["seed"] == twin.facts["seed"]
        and metric in run.values
        and metric in twin.values
        and (run.computer == twin.computer or not (metric in LIMITS and LIMITS[metric].here))
    ]
    if len(pairs) == 1:
        frames, others = (Figures.of(run).frames.get(metric, {}) for run in pairs[0])
        apart = [others[name] - frames[name] for name in frames if name in others]
        if len(apart) > 1:
            return np.array(apart), f"{len(apart)} frames of one seed", False
    differences = [twin.values[metric] - run.values[metric] for run, twin in pairs]
    several = len(pairs) > 1
    return np.array(differences), f"{len(pairs)} seeds" if several else "one figure each", several


def table(found: Sequence[Step]) -> Table:
    """`found` as a table."""
    columns = ("grows in the paper", "here by", "95 % interval", "over", "")
    return Table("Trends", columns, tuple(map(_line, found)))


def _line(step: Step) -> tuple[str, ...]:
    scale = 1e6 if step.metric.startswith("size_bytes") else 1.0
    by, half = step.by / scale, step.half / scale
    return (
        f"{written(step.metric)[0].rstrip(' ↑↓')}: {step.smaller} < {step.larger}",
        f"{by:+.3f}",
        f"{by - half:+.3f} to {by + half:+.3f}" if half >= 0 and step.over != COMPUTED else "",
        step.over,
        step.verdict,
    )

"""Trends of the paper, step by step: whether a metric grows here as it grows there."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from bench.intervals import half_interval
from reports.comparison import metric_format
from reports.regression import LIMITS, Figures
from reports.runs import Repeated
from reports.tables import Table

HOLDS, FAILS, OPEN = "holds", "does not hold", "cannot be told"
SEEN, REVERSED = "so, by one seed", "the reverse, by one seed"
"""Verdicts from the frames of one seed: another training may turn them around."""

COMPUTED = "computed, not sampled"


@dataclass(frozen=True)
class Trend:
    """`metric` grows along the lines `rising`, which are labels."""

    metric: str
    rising: Sequence[str]


@dataclass(frozen=True)
class Step:
    """From one line of a trend to the next.

    Attributes:
        by: the growth of the metric.
        half: half of the 95 % interval of `by`; nan where it is not known.
        over: the samples that `by` is the mean of, in words.
        proves: whether the interval covers the differences between trainings.
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
        """Whether the metric grows, does not, or neither can be told."""
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
            differences, over, proves = _differences(one, other, trend.metric)
            if len(differences):
                half = half_interval(differences)
                if trend.metric.startswith("size_bytes"):
                    half, over, proves = 0.0, COMPUTED, True
                by = float(differences.mean())
                yield Step(trend.metric, smaller, larger, by, half, over, proves)


def _differences(one: Repeated, other: Repeated, metric: str) -> tuple[np.ndarray, str, bool]:
    """Differences of pairs [n], what the pairs are, and whether they cover several trainings.

    Pairs have the same seed if there are several seeds, else they are the same frame of one seed.
    """
    anywhere = not (metric in LIMITS and LIMITS[metric].here)
    pairs = [
        (run, twin)
        for run in one.runs
        for twin in other.runs
        if run.facts["seed"] == twin.facts["seed"]
        and metric in run.values
        and metric in twin.values
        and (anywhere or run.computer == twin.computer)
    ]
    if len(pairs) == 1:
        frames, others = (Figures.of(run).frames.get(metric, {}) for run in pairs[0])
        by_frame = [others[name] - frames[name] for name in frames if name in others]
        if len(by_frame) > 1:
            return np.array(by_frame), f"{len(by_frame)} frames of one seed", False
    by_seed = np.array([twin.values[metric] - run.values[metric] for run, twin in pairs])
    several = len(pairs) > 1
    return by_seed, f"{len(pairs)} seeds" if several else "one figure each", several


def trend_table(found: Sequence[Step]) -> Table:
    """The steps `found`, a line each."""
    columns = ("grows in the paper", "here by", "95 % interval", "over", "")
    return Table("Trends", columns, tuple(map(_line, found)))


def _line(step: Step) -> tuple[str, ...]:
    scale = 1e6 if step.metric.startswith("size_bytes") else 1.0
    by, half = step.by / scale, step.half / scale
    return (
        f"{metric_format(step.metric)[0].rstrip(' ↑↓')}: {step.smaller} < {step.larger}",
        f"{by:+.3f}",
        f"{by - half:+.3f} to {by + half:+.3f}" if half >= 0 and step.over != COMPUTED else "",
        step.over,
        step.verdict,
    )

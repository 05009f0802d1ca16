"""One line of a table that was measured with several seeds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from bench.run import half_interval
from reports.runs import Run


@dataclass(frozen=True)
class Repeated:
    """The runs of a line, which differ in their seed alone; its figures are means over them.

    Attributes:
        label: what it is called.
        runs: one for each seed that was measured.
        gaps: why others are missing.
    """

    label: str
    runs: Sequence[Run]
    gaps: Sequence[str] = ()

    @cached_property
    def values(self) -> dict[str, float]:
        """Means by metric, of those that all runs have."""
        if not self.runs:
            return {}
        tables = [run.values for run in self.runs]
        names = [name for name in tables[0] if all(name in table for table in tables)]
        return {name: float(np.mean([table[name] for table in tables])) for name in names}

    @property
    def conditions(self) -> tuple[object, ...]:
        """See `Run.conditions`."""
        return self.runs[0].conditions if self.runs else ()

    def figures(self, metric: str) -> list[float]:
        """A metric with every seed; that of a stage with the stages inside it."""
        return [figure for run in self.runs if (figure := _figure(run, metric)) is not None]

    def mean(self, metric: str) -> float | None:
        """The mean of a metric and of the stages inside it; None where there is nothing."""
        figures = self.figures(metric)
        return float(np.mean(figures)) if figures else None

    def half(self, metric: str) -> float:
        """Half of the 95 % interval of that mean; nan with fewer than two seeds."""
        return half_interval(np.array(self.figures(metric)))


def _figure(run: Run, metric: str) -> float | None:
    inside = [value for name, value in run.values.items() if name.startswith(f"{metric}/")]
    if metric not in run.values and not inside:
        return None
    return math.fsum((run.values.get(metric, 0.0), *inside))

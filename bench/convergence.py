"""Run time against error of computations whose exact answer is known; the order of convergence."""

import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from bench.clock import times_ms
from bench.kinds import Rows
from bench.types import Log


@dataclass(frozen=True)
class Trial:
    """One setting of a knob, a number or a word; `call` approximates `exact`, float64, with it."""

    setting: float | str
    call: Callable[[], Tensor]
    exact: Tensor


@dataclass(frozen=True)
class Experiment:
    """A computation whose exact answer is known, and a knob that trades its time for its error."""

    subject: str  # what is computed
    knob: str  # the parameter that is varied, with its unit
    trials: Sequence[Trial]
    smooth: tuple[float, float] | None = None  # settings whose error is a power of the knob, if any


@torch.no_grad()
def experiment_rows(experiments: Sequence[Experiment], repeats: int, log: Log) -> Rows:
    """Run the experiments; one row for each trial: its largest absolute error, median and extremes
    of `repeats` times, and the observed order, fitted on the `smooth` settings."""
    rows = []
    with log.progress("experiments", len(experiments)) as progress:
        for experiment in experiments:
            trials = experiment.trials
            apart = ((trial.call().double() - trial.exact).abs() for trial in trials)
            errors = [float(difference.max()) for difference in apart]  # and warms up
            fit = dict.fromkeys(("order", "order_from", "order_to"))
            if experiment.smooth:
                low, high = experiment.smooth
                pairs = [(float(x.setting), e) for x, e in zip(trials, errors, strict=True)]
                smooth = [(setting, error) for setting, error in pairs if low <= setting <= high]
                order = observed_order(*zip(*smooth, strict=True))
                fit = {"order": order, "order_from": low, "order_to": high}
            times = times_ms([trial.call for trial in trials], repeats)
            about = {"subject": experiment.subject, "knob": experiment.knob, **fit}
            for trial, error, ms in zip(trials, errors, times, strict=True):
                row = {"setting": trial.setting, "error": error, "ms": statistics.median(ms)}
                rows.append({**about, **row, "ms_lo": min(ms), "ms_hi": max(ms)})
            progress.advance(note=experiment.subject)
    return rows


def observed_order(knob: Sequence[float], error: Sequence[float]) -> float:
    """The power p of error = c knob^p, by least squares on the logarithms of positive values."""
    slope, _ = np.polyfit(np.log(knob), np.log(error), 1)
    return float(slope)

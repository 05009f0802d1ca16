"""Run time against error, for computations with a known exact answer and for whole methods; the
Pareto frontier of settings that trade one for the other.

The compared settings take turns; times come from further rounds of what gave the errors.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import compress, product
from typing import Any

import numpy as np
import torch
from torch import Tensor

from bench.clock import FrameRecord, StageClock, p99_to_p50, times_ms
from bench.errors import unexpected
from bench.metrics import psnr, psnr_of_mse
from bench.protocol import EvaluationProtocol
from bench.scoring import check_frame
from bench.trajectories import Trajectory
from bench.types import Log, Method, Scene, composite


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
def experiment_rows(
    experiments: Sequence[Experiment], repeats: int, log: Log
) -> list[dict[str, Any]]:
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
            about = {"subject": experiment.subject, "knob": experiment.knob}
            rows += [
                {**about, "setting": trial.setting, "error": error, **_spread(of_trial), **fit}
                for trial, error, of_trial in zip(trials, errors, times, strict=True)
            ]
            progress.advance(note=experiment.subject)
    return rows


def _spread(times: Sequence[float]) -> dict[str, float]:
    return {"ms": statistics.median(times), "ms_lo": min(times), "ms_hi": max(times)}


def render_in_turns(
    methods: Mapping[str, Method],
    scene: Scene,
    trajectory: Trajectory,
    protocol: EvaluationProtocol,
    repeats: int,
    log: Log,
) -> list[dict[str, Any]]:
    """Render the same trajectory with all fitted `methods` in turns, in several rounds.

    Each frame is rendered by one method after the other. The first round warms up and is scored;
    `repeats` more are timed.

    Returns one row for each method, of the steady frames (`steady_frames`): setting (its name), ms
    (mean frame time of the lower median round), ms_lo and ms_hi (extremes over the rounds), and for
    the median round p99_to_p50, stage_ms.* and work.* as in `bench.run.measure`. Of the frames with
    a ground truth, rounded as `protocol` says: psnr (mean over frames), psnr_to_first (against the
    first method, from the MSE over all frames; inf if equal) and worst (largest difference of any
    channel from the first method, on a scale of 1).

    Raises SteerbenchError if no frame is both steady and has a ground truth, or a method rendered
    values that are not finite.
    """
    images = scene.splits[trajectory.split].images
    ready, scored = steady_frames(methods.values(), trajectory)
    clocks = {
        name: StageClock(method.settings()["device"], stages=protocol.stages)
        for name, method in methods.items()
    }
    first: dict[int, Tensor] = {}
    compared: dict[str, list[tuple[float, float, float]]] = {name: [] for name in methods}
    steps = trajectory.steps
    total = (repeats + 1) * len(methods) * len(steps)
    with torch.no_grad(), log.progress("rendering", total) as progress:
        for round_ in range(repeats + 1):
            for method in methods.values():
                method.reset()
            for (number, step), (name, clock) in product(enumerate(steps), clocks.items()):
                with clock.frame():
                    frame = methods[name].render(step.camera, clock)
                check_frame(frame, step.camera, name, number)
                if round_ == 0 and number in scored and step.truth is not None:
                    picture = protocol.rounded(frame.rgb).cpu()
                    truth = composite(images[step.truth], scene.background)
                    apart = picture.double() - first.setdefault(number, picture).double()
                    square, largest = apart.square().mean().item(), apart.abs().max().item()
                    compared[name].append((psnr(picture, truth), square, largest))
                progress.advance(note=f"round {round_} of {repeats}" if round_ else "warming up")
    rows = []
    for name, clock in clocks.items():
        scores, squares, worst = zip(*compared[name], strict=True)
        figures = {
            "psnr": statistics.fmean(scores),
            "psnr_to_first": psnr_of_mse(statistics.fmean(squares)),
            "worst": max(worst),
        }
        rows.append({"setting": name, **_costs(clock.frames, ready), **figures})
    return rows


def steady_frames(
    methods: Iterable[Method], trajectory: Trajectory
) -> tuple[list[bool], list[int]]:
    """Which frames are steady, and the indices of the steady frames with a ground truth.

    A frame is steady if, since the last cut, it has as many preceding frames as the method with
    the longest memory uses. Raises SteerbenchError if none of these has a ground truth.
    """
    start = max(method.memory for method in methods)
    ready = [count >= start for count in trajectory.preceding]
    scored = [n for n, step in enumerate(trajectory.steps) if ready[n] and step.truth is not None]
    if not scored:
        expected = f"a frame with a ground truth and {start} frames before it, without a cut"
        got = f"none in {len(trajectory.steps)} frames; give more frames"
        raise unexpected(trajectory.name, expected, got)
    return ready, scored


def _costs(records: Sequence[FrameRecord], ready: Sequence[bool]) -> dict[str, float]:
    """Costs of the `ready` frames over all rounds but the first; see `render_in_turns`."""
    count = len(ready)
    rounds = [
        list(compress(records[first : first + count], ready))
        for first in range(count, len(records), count)
    ]
    means = [statistics.fmean(record.total_ns / 1e6 for record in of_round) for of_round in rounds]
    ms = statistics.median_low(means)
    usual = rounds[means.index(ms)]
    return {
        **_spread(means),
        "ms": ms,  # median_low: of an actual round, which the next lines describe
        "p99_to_p50": p99_to_p50(usual),
        **mean_figures("stage_ms", [record.stages_ns for record in usual], 1e-6),
        **mean_figures("work", [record.done for record in usual]),
    }


def mean_figures(
    kind: str, of_frames: Sequence[Mapping[str, int]], factor: float = 1
) -> dict[str, float]:
    """Mean over frames of every figure that any frame has; a missing figure counts as 0."""
    names = dict.fromkeys(name for figures in of_frames for name in figures)
    return {
        f"{kind}.{name}": factor * statistics.fmean(figures.get(name, 0) for figures in of_frames)
        for name in names
    }


def best_instead(cost: Sequence[float], error: Sequence[float]) -> list[int]:
    """For each setting, the index of the best setting that costs no more.

    Best is the least `error`, then the least `cost`, then the lowest index: on the Pareto frontier
    the setting itself, elsewhere one that dominates it.
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
    """The power p of error = c knob^p, by least squares on the logarithms of positive values."""
    slope, _ = np.polyfit(np.log(knob), np.log(error), 1)
    return float(slope)

"""Run time against error, for computations with a known exact answer and for whole methods.

The compared settings take turns; times come from further rounds of what gave the errors.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import compress, product
from typing import Any

import torch
from torch import Tensor

from bench.compositing import composite
from bench.frontier import observed_order
from bench.metrics import psnr, psnr_of_mse
from bench.probes import FrameRecord, StageClock, p99_to_p50, times_ms
from bench.protocol import EvaluationProtocol
from bench.scoring import check_frame
from bench.trajectories import Trajectory
from bench.types import Log, Method, Scene, SteerbenchError


@dataclass(frozen=True)
class Trial:
    """One setting of a knob, a number or a word; `call` approximates `exact`, float64, with it."""

    setting: float | str
    call: Callable[[], Tensor]
    exact: Tensor


@dataclass(frozen=True)
class Experiment:
    """A computation whose exact answer is known, and a knob that trades its time for its error.

    Attributes:
        subject: what is computed.
        knob: the parameter that is varied, with its unit.
        trials: the settings of the knob.
        smooth: the range of settings (lowest, highest) in which the error should follow a power
            of the knob; None: it follows none, or rounding hides it.
    """

    subject: str
    knob: str
    trials: Sequence[Trial]
    smooth: tuple[float, float] | None = None


@torch.no_grad()
def experiment_rows(
    experiments: Sequence[Experiment], repeats: int, log: Log
) -> list[dict[str, Any]]:
    """Run the experiments; one row for each trial.

    A row holds subject, knob, setting, error (largest absolute), ms (median of `repeats`), ms_lo
    and ms_hi (the extremes), and order, the observed one, fitted on the settings from order_from to
    order_to; these three are None where no order is expected.
    """
    rows = []
    with log.progress("experiments", len(experiments)) as progress:
        for experiment in experiments:
            trials = experiment.trials
            apart = ((trial.call().double() - trial.exact).abs() for trial in trials)
            errors = [float(difference.max()) for difference in apart]  # and warms up
            order = _order(experiment, errors)
            low, high = experiment.smooth or (None, None)
            times = times_ms([trial.call for trial in trials], repeats)
            rows += [
                {
                    "subject": experiment.subject,
                    "knob": experiment.knob,
                    "setting": trial.setting,
                    "error": error,
                    **_spread(of_trial),
                    "order": order,
                    "order_from": low,
                    "order_to": high,
                }
                for trial, error, of_trial in zip(trials, errors, times, strict=True)
            ]
            progress.advance(note=experiment.subject)
    return rows


def _order(experiment: Experiment, errors: Sequence[float]) -> float | None:
    if experiment.smooth is None:
        return None
    low, high = experiment.smooth
    settings = [float(trial.setting) for trial in experiment.trials]
    pairs = zip(settings, errors, strict=True)
    fitted = [(setting, error) for setting, error in pairs if low <= setting <= high]
    return observed_order(*zip(*fitted, strict=True))


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

    Returns:
        One row for each method, of the steady frames (`steady_frames`): setting (its name), ms
        (mean frame time of the lower median round), ms_lo and ms_hi (extremes over the rounds), and
        for the median round p99_to_p50, stage_ms.* and work.* as in `bench.run.measure`. Of the
        frames with a ground truth, rounded as `protocol` says: psnr (mean over frames),
        psnr_to_first (against the first method, from the MSE over all frames; inf if equal) and
        worst (largest difference of any channel from the first method, on a scale of 1).

    Raises:
        SteerbenchError: no frame is both steady and has a ground truth, or a method rendered
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
    the longest memory uses.

    Raises:
        SteerbenchError: no steady frame has a ground truth.
    """
    start = max(method.memory for method in methods)
    ready = [count >= start for count in trajectory.preceding]
    scored = [n for n, step in enumerate(trajectory.steps) if ready[n] and step.truth is not None]
    if not scored:
        raise SteerbenchError(
            f"{trajectory.name}: none of its {len(trajectory.steps)} frames has a ground truth and "
            f"{start} frames before it to look back on, without a cut; give more frames"
        )
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

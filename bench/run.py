"""One run: Method x Scene x Trajectory x Protocol -> rows.

Quality, time and memory of a run come from the same rendering of the same frames.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch

from bench.clock import StageClock
from bench.intervals import path_interval
from bench.memory import MemoryMeter, give_back
from bench.metrics import Lpips
from bench.neighbours import Neighbours, Watch
from bench.protocol import EvaluationProtocol
from bench.results import COLD, STEADY, WHOLE, Measurement
from bench.scoring import ERROR_RANGE, PICTURES, Scoring, check_frame
from bench.trajectories import Trajectory, spread
from bench.types import Budget, Log, Method, Scene

QUANTILES = (50, 95, 99)
UNITS = {
    **{"psnr": "dB", "tpsnr": "dB", "jod": "JOD", "fps": "1/s", "work": "1/frame", "train_s": "s"},
    **{"frame_ms": "ms", "wall_ms": "ms", "stage_ms": "ms", "size_bytes": "B", "peak_bytes": "B"},
}
"""Units of metrics, by name up to the first dot; other metrics have no unit."""


@dataclass(frozen=True)
class Task:
    """What a method is measured on."""

    scene: Scene
    trajectory: Trajectory
    protocol: EvaluationProtocol
    budget: Budget
    seed: int  # of the method; only written into the rows
    weights_dir: Path | None = None  # where LPIPS backbones are searched first
    pictures: int = PICTURES  # scored frames whose pictures are kept


class MethodFailed(Exception):
    """One of several methods failed, `method`; its error is the cause."""

    def __init__(self, method: Method) -> None:
        super().__init__(method.name)
        self.method = method


@contextmanager
def _named(method: Method, several: bool) -> Iterator[None]:
    """Raise an error of the body as MethodFailed if there are `several` methods."""
    try:
        yield
    except Exception as error:
        if several:
            raise MethodFailed(method) from error
        raise


def measure(methods: Sequence[Method], task: Task, log: Log) -> list[Measurement]:
    """Fit `methods` to the scene of `task`; render its trajectory under the clock and score it.

    Several methods render each frame one after the other, so that their times come from the same
    minutes. Peak memory of the process is that of all methods together. Raises SteerbenchError if
    the scene does not fit the protocol, or a method rendered values that are not finite; of several
    methods, MethodFailed for whatever one of them raises.
    """
    lpips, missing = task.protocol.load_lpips(task.weights_dir, log)
    task.protocol.check(task.scene, task.trajectory)
    for split in task.scene.splits.values():
        list(split.images)  # decode now, so damaged files raise here, not during training or timing
    for method in methods:
        with _named(method, len(methods) > 1):
            method.fit(task.scene, task.budget, log)
    takes = [_Take(method, task, lpips) for method in methods]
    neighbours = _render(takes, task, log)
    if neighbours.notable:
        log.info(f"{neighbours} while frames were timed: times are longer than they need be")
    measurements = []
    for take in takes:
        with _named(take.method, len(takes) > 1):
            measurements.append(_measurement(take, task, missing, neighbours, len(takes)))
    return measurements


class _Take:
    """A method being measured: its clock, memory meter, scoring, and a row per rendered frame."""

    def __init__(self, method: Method, task: Task, lpips: Mapping[str, Lpips]) -> None:
        self.method, device = method, method.settings()["device"]
        self.clock = StageClock(device, stages=task.protocol.stages)
        self.meter = MemoryMeter(device)
        scored = [n for n, step in enumerate(task.trajectory.steps) if step.truth is not None]
        shown = {scored[n] for n in spread(len(scored), task.pictures)}
        scene = task.scene
        self.scoring = Scoring(task.protocol, lpips, scene.background, shown, scene.surface)
        self.rows: list[dict[str, Any]] = []

    def metered(self, *, warm: bool = False) -> AbstractContextManager[object]:
        """The meter, around a frame whose memory counts; around others, nothing.

        On a GPU the frames of the path count. A process also holds what scoring has left in it: on
        a CPU the `warm` frames before count (of several, all but the first) or, without any, the
        first of the path.
        """
        counts = warm or not self.meter.peak_bytes if self.meter.of_process else not warm
        return self.meter if counts else nullcontext()

    @property
    def timed_here(self) -> bool:
        """Whether no other process has told the times of frames."""
        return all(frame.wall_ns is None for frame in self.clock.frames)

    def peak(self, in_turns: int) -> tuple[float, str]:
        """Peak memory in bytes, NaN if it is not known, and what was read; `in_turns` methods were
        measured together."""
        if self.timed_here:
            source = self.meter.source + ", before its frames were scored" * self.meter.of_process
            source += f", of {in_turns} methods in turns" * (in_turns > 1)
            return self.meter.peak_bytes, source
        peaks = (frame.peak_bytes for frame in self.clock.frames)
        told = [peak for peak in peaks if peak is not None]
        if not told:
            return math.nan, "not told by the process that rendered"
        return max(told), "as the process that rendered has told"

    @property
    def times(self) -> str:
        """Whose times those of the frames are."""
        if self.timed_here:
            return "read here, after the device has finished its work"
        return "read by the process that rendered; wall_ms: read here, with the way there and back"


def _measurement(
    take: _Take, task: Task, missing: Mapping[str, str], neighbours: Neighbours, in_turns: int
) -> Measurement:
    """What was measured of one of `in_turns` methods."""
    scene, trajectory, protocol, budget = task.scene, task.trajectory, task.protocol, task.budget
    method, scoring, sizes = take.method, take.scoring, take.method.sizes()
    peak_bytes, source = take.peak(in_turns)
    frames = _frame_table(take.rows, scoring.names)
    of_phases = ((phase, frames[frames["phase"] == phase]) for phase in (STEADY, COLD))
    summary = [
        *(row | {"phase": phase} for phase, of in of_phases if len(of) for row in phase_rows(of)),
        *(single(f"size_bytes.{part}", size) for part, size in sizes.items()),
        *([single("size_bytes.total", sum(sizes.values()))] if sizes else []),
        single("peak_bytes", peak_bytes),
        single("train_s", method.train_s),
        *(single(name, value) for name, value in scoring.whole().items()),
    ]
    known = [row["metric"] for row in summary if row["n"]]
    rows = pd.DataFrame(summary).assign(
        unit=lambda table: [UNITS.get(name.split(".")[0], "1") for name in table["metric"]],
        method=method.name,
        scene=scene.name,
        split=trajectory.split,
        trajectory=trajectory.name,
        resolution=trajectory.resolution,
        protocol=protocol.name,
        budget=budget.name,
        seed=task.seed,
        **method.settings(),
    )
    record: dict[str, Any] = {
        "protocol": asdict(protocol),
        "budget": asdict(budget),
        "scene": {"name": scene.name, "digest": scene.digest, "unit_length": scene.unit_length},
        "missing": {**missing, **scoring.missing(known)},
        "neighbours": neighbours._asdict(),
        "peak_bytes": source,
        "times": take.times,
        "error_map": f"absolute error, mean over the channels, black 0 to yellow {ERROR_RANGE}",
    }
    return Measurement(rows, frames, scoring.images, record)


def _render(takes: Sequence[_Take], task: Task, log: Log) -> Neighbours:
    """Warm up, then render the sequence in order; what other processes used in the second part."""
    steps, preceding = task.trajectory.steps, task.trajectory.preceding
    warmup = spread(len(steps), task.protocol.warmup)
    frames = len(takes) * (len(warmup) + len(steps))
    with torch.no_grad(), log.progress("rendering", frames) as progress:
        for take in takes:
            with _named(take.method, len(takes) > 1):
                take.method.reset()
        for number, take in product(warmup, takes):
            settled = number > 0 or len(warmup) == 1  # in the first, kernels may be compiled
            if settled:
                give_back()  # what compiling has freed
            with (
                _named(take.method, len(takes) > 1),
                take.metered(warm=True) if settled else nullcontext(),
                take.clock.frame(),
            ):
                take.method.render(steps[number].camera, take.clock)
            progress.advance(note="warming up")
        for take in takes:
            with _named(take.method, len(takes) > 1):
                take.method.reset()
        watch = Watch()
        for index, take in product(range(len(steps)), takes):
            with _named(take.method, len(takes) > 1):
                _draw(take, task, index, preceding[index])
            scores = [row["psnr"] for row in take.rows if "psnr" in row]
            progress.advance(note=f"{np.mean(scores):.2f} dB" if scores else "")
        return watch.seen()


def _draw(take: _Take, task: Task, index: int, before: int) -> None:
    """Render and score the next frame of a method; `before` frames precede it since the last cut.

    The method is not told of cuts, because a user who steers a camera does not announce a jump.
    """
    method, step = take.method, task.trajectory.steps[index]
    if task.protocol.memory == "cold":
        method.reset()
        before = 0
    with take.metered(), take.clock.frame():
        frame = method.render(step.camera, take.clock)
    check_frame(frame, step.camera, method.name, index)
    phase = COLD if before < method.memory else STEADY
    record = take.clock.frames[-1]
    figures: dict[str, Any] = {
        "frame": index,
        "phase": phase,
        "frame_ms": record.total_ns / 1e6,
        **({} if record.wall_ns is None else {"wall_ms": record.wall_ns / 1e6}),
        **{f"stage_ms.{name}": ns / 1e6 for name, ns in record.stages_ns.items()},
        **{f"work.{name}": done for name, done in record.done.items()},
        **{f"work.{name}.dense": dense for name, dense in record.dense.items()},
    }
    truth: torch.Tensor | None = None
    if step.truth is not None:
        split = task.scene.splits[task.trajectory.split]
        figures["name"], truth = split.names[step.truth], split.images[step.truth]
    elif task.protocol.flicker == "exact" and task.scene.exact is not None:
        truth = task.scene.exact(step.camera)
    scored = step.truth is not None
    scores = take.scoring.score(
        index,
        frame.rgb,
        truth,
        scored=scored,
        cut=step.cut,
        camera=step.camera,
        depth=frame.depth,
    )
    take.rows.append(figures | scores)


def _frame_table(table: list[dict[str, Any]], scores: Sequence[str]) -> pd.DataFrame:
    """One row per frame; missing stages and counters are 0, missing scores NaN."""
    frames = pd.DataFrame(table)
    touched = [name for name in map(str, frames) if name.startswith(("stage_ms.", "work."))]
    touched.sort(key=lambda name: (name.startswith("work."), name == "stage_ms.other"))
    times = [name for name in ("frame_ms", "wall_ms") if name in frames]
    columns = ["frame", "name", "phase", *scores, *times, *touched]
    return frames.reindex(columns=columns).fillna(dict.fromkeys(touched, 0))


def phase_rows(frames: pd.DataFrame) -> list[dict[str, Any]]:
    """Mean and interval of every column, quantiles of the frame time, frames per second.

    `frames` are at least one, in path order, with columns `frame`, `name` and `phase`, scores,
    times, work.
    """
    columns = list(map(str, frames))
    scores = columns[columns.index("phase") + 1 : columns.index("frame_ms")]
    parts = [name for name in columns if name.startswith(("stage_ms.", "work."))]
    times = frames["frame_ms"]
    ms = mean_row("frame_ms", times)
    return [
        *score_rows(frames, scores),
        ms,
        *(single(f"frame_ms.p{part}", np.percentile(times, part)) for part in QUANTILES),
        # No upper end if the interval of the time reaches 0.
        {"metric": "fps", "n": ms["n"], "value": 1000 / ms["value"], "lo": 1000 / ms["hi"]}
        | {"hi": 1000 / ms["lo"] if ms["lo"] > 0 else math.nan},
        *(mean_row(name, frames[name]) for name in columns if name == "wall_ms"),
        *(mean_row(name, frames[name]) for name in parts),
    ]


def score_rows(frames: pd.DataFrame, scores: Sequence[str]) -> list[dict[str, Any]]:
    """Mean and interval of each of `scores`; of the flicker only where a frame has one."""
    named = [name for name in scores if name != "flicker" or frames[name].notna().any()]
    return [mean_row(name, frames[name]) for name in named]


def mean_row(metric: str, values: pd.Series) -> dict[str, Any]:
    """The row of a metric: mean and interval over the frames, in path order, that have a value."""
    known = values.dropna().to_numpy(dtype=float)
    value = known.mean() if len(known) else math.nan
    half = path_interval(known)
    figures = {"value": value, "n": len(known), "lo": value - half, "hi": value + half}
    return {"metric": metric} | figures


def single(metric: str, value: float) -> dict[str, Any]:
    """The row of a single figure; it belongs to the whole run unless its phase is replaced."""
    known = int(not math.isnan(value))
    row = {"metric": metric, "value": float(value), "n": known, "lo": math.nan, "hi": math.nan}
    return row | {"phase": WHOLE}

"""One run: Method x Scene x Trajectory x Protocol -> rows. The only loop that renders frames for
figures is here: `_render`.

Quality, time and memory of a run come from the same rendering of the same frames.
"""

import math
import statistics
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from bench.clock import FrameRecord, StageClock
from bench.errors import unexpected
from bench.memory import MemoryMeter, give_back
from bench.metrics import Lpips, psnr_of_mse
from bench.neighbours import Neighbours, Watch
from bench.protocol import EvaluationProtocol
from bench.results import COLD, STEADY, Measurement
from bench.rows import phase_rows, row_table, single
from bench.scoring import ERROR_RANGE, PICTURES, Scoring, check_frame
from bench.study import study_of
from bench.trajectories import Trajectory, spread
from bench.types import Budget, Log, Method, Scene
from bench.waits import CodeLine, device_waits


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


def train(methods: Sequence[Method], task: Task, log: Log) -> None:
    """Fit `methods` to the scene of `task`.

    Raises SteerbenchError if the scene does not fit the protocol; of several methods, MethodFailed
    for whatever one of them raises.
    """
    task.protocol.check(task.scene, task.trajectory)
    if task.protocol.compared:
        _check_steady(methods, task.trajectory)
    for split in task.scene.splits.values():
        list(split.images)  # decode now, so damaged files raise here, not during training or timing
        list(split.masks)
    for method in methods:
        with _named(method, len(methods) > 1):
            method.fit(task.scene, task.budget, log)


def measure(methods: Sequence[Method], task: Task, log: Log) -> list[Measurement]:
    """Render the trajectory of `task` with trained `methods` under the clock, and score it.

    Several methods render each frame one after the other, so that their times come from the same
    minutes. The first round through the trajectory is scored; with `protocol.rounds`, times and
    work come from that further round whose mean time of the steady frames is the lower median.
    Peak memory of the process is that of all methods together. Raises SteerbenchError if a method
    rendered values that are not finite; of several methods, MethodFailed for whatever one of them
    raises.
    """
    lpips, missing = task.protocol.load_lpips(task.weights_dir, log)
    takes = [_Take(method, task, lpips) for method in methods]
    neighbours = _render(takes, task, log)
    if neighbours.notable:
        log.info(f"{neighbours} while frames were timed: times are longer than they need be")
    measurements = []
    for take in takes:
        with _named(take.method, len(takes) > 1):
            measurements.append(_measurement(take, task, missing, neighbours, len(takes)))
    return measurements


def _check_steady(methods: Sequence[Method], trajectory: Trajectory) -> None:
    """Raise SteerbenchError unless a frame with a ground truth has, since the last cut, as many
    frames before it as the method with the longest memory uses."""
    start, steps = max(method.memory for method in methods), trajectory.steps
    pairs = zip(trajectory.preceding, steps, strict=True)
    if not any(before >= start and step.truth is not None for before, step in pairs):
        expected = f"a frame with a ground truth and {start} frames before it, without a cut"
        raise unexpected(trajectory.name, expected, f"none in {len(steps)}; give more frames")


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
        self.rows: list[dict[str, Any]] = []  # of the first round
        # Of its steady frames with a ground truth, how far they are from the first method's: MSE,
        # and largest difference of any channel.
        self.apart: list[tuple[float, float]] = []
        self.waits: list[Counter[CodeLine]] = []  # of steady frames, if the protocol counts them

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

    def timed(self, warmup: int) -> tuple[list[FrameRecord], list[float]]:
        """The records of the frames that are reported: of the only round or, of several, of that
        timed one whose mean time of the steady frames is the lower median; all such means, in ms.
        The first `warmup` records are of no round."""
        count = len(self.rows)
        records = self.clock.frames[warmup:]
        rounds = [records[begin : begin + count] for begin in range(0, len(records), count)]
        rounds = rounds[1:] or rounds
        steady = [n for n, row in enumerate(self.rows) if row["phase"] == STEADY] or range(count)
        means = [statistics.fmean(of[n].total_ns for n in steady) / 1e6 for of in rounds]
        return rounds[means.index(statistics.median_low(means))], means


def _measurement(
    take: _Take, task: Task, missing: Mapping[str, str], neighbours: Neighbours, in_turns: int
) -> Measurement:
    """What was measured of one of `in_turns` methods."""
    scene, trajectory, protocol, budget = task.scene, task.trajectory, task.protocol, task.budget
    method, scoring, sizes = take.method, take.scoring, take.method.sizes()
    peak_bytes, source = take.peak(in_turns)
    records, means = take.timed(len(take.clock.frames) - protocol.rounds * len(take.rows))
    rows_of_frames = [row | _costs(timed) for row, timed in zip(take.rows, records, strict=True)]
    frames = _frame_table(rows_of_frames, scoring.names)
    of_phases = ((phase, frames[frames["phase"] == phase]) for phase in (STEADY, COLD))
    whole: dict[str, float] = {}
    if protocol.rounds > 1:
        whole |= {"frame_ms.fastest": min(means), "frame_ms.slowest": max(means)}
    if take.apart:  # the PSNR from the MSE over all frames, inf if they are equal
        mse, worst = zip(*take.apart, strict=True)
        whole |= {"psnr_to_first": psnr_of_mse(statistics.fmean(mse)), "worst_to_first": max(worst)}
    whole |= {f"size_bytes.{part}": size for part, size in sizes.items()}
    whole |= {"size_bytes.total": sum(sizes.values())} if sizes else {}
    whole |= {"peak_bytes": peak_bytes, "train_s": method.train_s}
    whole |= {"train_peak_bytes": getattr(method, "train_peak_bytes", math.nan)}
    summary = [
        *(row | {"phase": phase} for phase, of in of_phases if len(of) for row in phase_rows(of)),
        *(single(name, value) for name, value in whole.items()),
    ]
    known = [row["metric"] for row in summary if row["n"]]
    rows = row_table(
        summary,
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
        "parts": dict(study_of(method).parts),
        "missing": {**missing, **scoring.missing(known)},
        "neighbours": neighbours._asdict(),
        "peak_bytes": source,
        "times": take.times,
        "waits": _waits(take.waits),
        "error_map": f"absolute error, mean over the channels, black 0 to yellow {ERROR_RANGE}",
    }
    return Measurement(rows, frames, scoring.images, record)


def _waits(of_frames: Sequence[Counter[CodeLine]]) -> list[dict[str, Any]]:
    """Where the host waits for the GPU in a steady frame, the most frequent first."""
    return [
        {"waits": count / len(of_frames), "line": line.place, "source": line.source}
        for line, count in sum(of_frames, Counter()).most_common()
    ]


def _render(takes: Sequence[_Take], task: Task, log: Log) -> Neighbours:
    """Warm up, then render the sequence in order, as many rounds as the protocol has; what other
    processes used while it was timed."""
    steps, rounds = task.trajectory.steps, task.protocol.rounds
    warmup = spread(len(steps), task.protocol.warmup)
    frames = len(takes) * (len(warmup) + rounds * len(steps))
    with torch.no_grad(), log.progress("rendering", frames) as progress:
        _reset(takes)
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
        watch = Watch()
        for number in range(rounds):
            _reset(takes)
            if number == 1:
                watch = Watch()
            for index in range(len(steps)):
                first: Tensor | None = None
                for take in takes:
                    with _named(take.method, len(takes) > 1):
                        picture = _draw(take, task, index, first, scored=number == 0)
                    first = picture if first is None else first
                    scores = [row["psnr"] for row in take.rows if "psnr" in row]
                    progress.advance(note=f"{np.mean(scores):.2f} dB" if scores else "")
        return watch.seen()


def _reset(takes: Sequence[_Take]) -> None:
    for take in takes:
        with _named(take.method, len(takes) > 1):
            take.method.reset()


def _draw(take: _Take, task: Task, index: int, first: Tensor | None, *, scored: bool) -> Tensor:
    """Render the frame `index` with a method and return its picture; in the round that is `scored`
    also score it, and compare it with the picture of the `first` method, if there is one.

    The method is not told of cuts, because a user who steers a camera does not announce a jump.
    """
    method, step, protocol = take.method, task.trajectory.steps[index], task.protocol
    before = task.trajectory.preceding[index]
    counted = device_waits() if scored and protocol.waits else nullcontext()
    with counted as waits, take.metered(), take.clock.frame():
        frame = method.render(step.camera, take.clock)
    check_frame(frame, step.camera, method.name, index)
    if not scored:
        return frame.rgb
    phase = COLD if before < method.memory else STEADY
    if phase == STEADY and waits is not None:
        take.waits.append(waits)
    figures: dict[str, Any] = {"frame": index, "phase": phase}
    truth: Tensor | None = None
    mask: Tensor | None = None
    if step.truth is not None:
        split = task.scene.splits[task.trajectory.split]
        figures["name"], truth = split.names[step.truth], split.images[step.truth]
        mask = split.mask(step.truth)
    elif protocol.flicker == "exact" and task.scene.exact is not None:
        truth = task.scene.exact(step.camera)
    if protocol.compared and phase == STEADY and step.truth is not None:
        first = frame.rgb if first is None else first
        shown, other = (protocol.rounded(rgb).cpu().double() for rgb in (frame.rgb, first))
        apart = shown - other
        take.apart.append((apart.square().mean().item(), apart.abs().max().item()))
    scores = take.scoring.score(
        index,
        frame.rgb,
        truth,
        scored=step.truth is not None,
        cut=step.cut,
        camera=step.camera,
        depth=frame.depth,
        mask=mask,
    )
    take.rows.append(figures | scores)
    return frame.rgb


def _costs(record: FrameRecord) -> dict[str, float]:
    return {
        "frame_ms": record.total_ns / 1e6,
        **({} if record.wall_ns is None else {"wall_ms": record.wall_ns / 1e6}),
        **{f"stage_ms.{name}": ns / 1e6 for name, ns in record.stages_ns.items()},
        **{f"work.{name}": done for name, done in record.done.items()},
        **{f"work.{name}.dense": dense for name, dense in record.dense.items()},
    }


def _frame_table(table: list[dict[str, Any]], scores: Sequence[str]) -> pd.DataFrame:
    """One row per frame; missing stages and counters are 0, missing scores NaN."""
    frames = pd.DataFrame(table)
    touched = [name for name in map(str, frames) if name.startswith(("stage_ms.", "work."))]
    touched.sort(key=lambda name: (name.startswith("work."), name == "stage_ms.other"))
    times = [name for name in ("frame_ms", "wall_ms") if name in frames]
    columns = ["frame", "name", "phase", *scores, *times, *touched]
    return frames.reindex(columns=columns).fillna(dict.fromkeys(touched, 0))

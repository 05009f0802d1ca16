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

from bench.clock import FrameRecord, StageClock, counted
from bench.errors import unexpected
from bench.isolation import Guard, Isolated, check_originals, fit, lent, moved, sees_scored
from bench.kinds import Rows
from bench.memory import MemoryMeter, give_back
from bench.metrics import Lpips, psnr_of_mse
from bench.neighbours import Neighbours, Watch
from bench.protocol import EvaluationProtocol
from bench.results import COLD, STEADY, Measurement
from bench.rows import phase_rows, row_table, single
from bench.scoring import ERROR_RANGE, PICTURES, Scoring, taken
from bench.study import study_of
from bench.trajectories import Trajectory, spread
from bench.types import Budget, Frame, Log, Method, NullProbe, Scene
from bench.waits import CodeLine, device_waits

FEW, NOTABLE_MS, OFTEN, USUAL_MS = 0.2, 3.0, 0.1, 0.5
"""A time that a renderer reports is doubted below this share of the wall time, if so many
milliseconds are missing; a run, if that is so in more than such a share of its frames, and in more
than one: the system may pause in any. Of medians fewer milliseconds say as much."""


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


def train(methods: Sequence[Method], task: Task, log: Log) -> Guard:
    """Fit `methods` to the scene of `task`; returns what watches its pictures from then on.

    Raises SteerbenchError if the scene does not fit the protocol, or a method changed its pictures;
    of several methods, MethodFailed for whatever one of them raises.
    """
    task.protocol.check(task.scene, task.trajectory)
    if task.protocol.compared:
        _check_steady(methods, task.trajectory)
    guard = Guard(task.scene, log)  # before any training, which damaged files would end
    for method in methods:
        with _named(method, len(methods) > 1):
            counted(f"{method.name}: memory", method.memory)
            fit(method, task.scene, task.budget, task.seed, log, guard)
    return guard


def measure(
    methods: Sequence[Method], task: Task, log: Log, guard: Guard | None = None
) -> list[Measurement]:
    """Render the trajectory of `task` with trained `methods` under the clock, and score it.

    Several methods render each frame one after the other, so that their times come from the same
    minutes. The first round through the trajectory is scored; with `protocol.rounds`, times and
    work come from that further round whose mean time of the steady frames is the lower median.
    Peak memory of the process is that of all methods together. Frames that are not scored show the
    scene from cameras a hair away, so that no method is timed on frames that it has kept. `guard`
    is what `train` returned. Raises SteerbenchError if a method rendered what is no frame, or
    changed pictures of the scene; of several methods, MethodFailed for whatever one of them raises.
    """
    lpips, missing = task.protocol.load_lpips(task.weights_dir, log)
    guard = guard or Guard(task.scene, log)
    takes = [_Take(method, task, lpips, len(methods) > 1, log) for method in methods]
    neighbours = _render(takes, task, log)
    if neighbours.notable:
        log.info(f"{neighbours} while frames were timed: times are longer than they need be")
    measurements = []
    for take in takes:
        with take.called():
            _repeat(take, task)
            measurement = _measurement(take, task, missing, neighbours, len(takes))
        for doubt in take.doubts:
            log.info(f"{take.method.name}: {doubt}")
        measurements.append(measurement)
    check_originals()
    guard.check(methods)
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

    def __init__(
        self, method: Method, task: Task, lpips: Mapping[str, Lpips], several: bool, log: Log
    ) -> None:
        self.method, self.several = method, several
        self._isolated = Isolated(method, task.seed, log)
        device = method.settings()["device"]
        self.clock = StageClock(device, stages=task.protocol.stages)
        self.meter = MemoryMeter(device)
        self.scoring = Scoring(
            task.protocol,
            lpips,
            task.scene.background,
            _shown(task),
            task.scene.surface,
        )
        self.rows: Rows = []  # of the first round
        # Of its steady frames with a ground truth, how far they are from the first method's: MSE,
        # and largest difference of any channel.
        self.apart: list[tuple[float, float]] = []
        self.waits: list[Counter[CodeLine]] = []  # of steady frames, if the protocol counts them
        self.middle = torch.empty(0)  # the picture in the middle of the path
        self.doubts: list[str] = []  # what a reader of its figures has to know

    @contextmanager
    def called(self) -> Iterator[None]:
        """The context of all calls of the method."""
        with _named(self.method, self.several), self._isolated.call():
            yield

    @contextmanager
    def timed_frame(self) -> Iterator[None]:
        """The context of a call of `render`: what is done about the call is not timed."""
        with self.called(), self.clock.frame():
            yield

    def mean_psnr(self) -> str:
        """The mean PSNR of the frames scored so far; empty without any."""
        scores = [row["psnr"] for row in self.rows if "psnr" in row]
        return f"{np.mean(scores):.2f} dB" if scores else ""

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


def _shown(task: Task) -> set[int]:
    """The frames whose pictures are kept: some of those with a ground truth, evenly spread."""
    scored = [n for n, step in enumerate(task.trajectory.steps) if step.truth is not None]
    return {scored[n] for n in spread(len(scored), task.pictures)}


def _measurement(
    take: _Take, task: Task, missing: Mapping[str, str], neighbours: Neighbours, in_turns: int
) -> Measurement:
    """What was measured of one of `in_turns` methods."""
    scene, trajectory, protocol = task.scene, task.trajectory, task.protocol
    method, scoring = take.method, take.scoring
    peak_bytes, source = take.peak(in_turns)
    records, means = take.timed(len(take.clock.frames) - protocol.rounds * len(take.rows))
    rows_of_frames = [row | _costs(timed) for row, timed in zip(take.rows, records, strict=True)]
    frames = _frame_table(rows_of_frames, scoring.names)
    summary: Rows = []
    for phase in (STEADY, COLD):
        of_phase = frames[frames["phase"] == phase]
        if len(of_phase):
            summary += [row | {"phase": phase} for row in phase_rows(of_phase)]
    whole: dict[str, float] = {}
    if protocol.rounds > 1:
        whole |= {"frame_ms.fastest": min(means), "frame_ms.slowest": max(means)}
    if take.apart:  # the PSNR from the MSE over all frames, inf if they are equal
        mse, worst = zip(*take.apart, strict=True)
        whole |= {"psnr_to_first": psnr_of_mse(statistics.fmean(mse)), "worst_to_first": max(worst)}
    whole |= _sizes(method) | {"peak_bytes": peak_bytes} | _costs_of_training(method)
    summary += [single(name, value) for name, value in whole.items()]
    facts = method.settings()
    if doubt := _doubted_times(records):
        take.doubts.append(doubt)
        facts = {**facts, "device": f"{facts['device']}, doubtful times"}
    seen = ", seen by the method" if sees_scored(method) else ""
    rows = row_table(
        summary,
        method=method.name,
        scene=scene.name,
        split=trajectory.split + seen,
        trajectory=trajectory.name,
        resolution=trajectory.resolution,
        protocol=protocol.name,
        budget=task.budget.name,
        seed=task.seed,
        **facts,
    )
    known = [row["metric"] for row in summary if row["n"]]
    record: dict[str, Any] = {
        "protocol": asdict(protocol),
        "budget": asdict(task.budget),
        "scene": {"name": scene.name, "digest": scene.digest, "unit_length": scene.unit_length},
        "parts": dict(study_of(method).parts),
        "missing": {**missing, **scoring.missing(known)},
        "neighbours": neighbours._asdict(),
        "peak_bytes": source,
        "times": take.times,
        "doubts": take.doubts,
        "waits": _waits(take.waits),
        "error_map": f"absolute error, mean over the channels, black 0 to yellow {ERROR_RANGE}",
    }
    return Measurement(rows, frames, scoring.images, record)


def _sizes(method: Method) -> dict[str, float]:
    """The bytes of each component of `method`, and of all; none if it tells none."""
    found: dict[str, float] = {
        f"size_bytes.{part}": counted(f"{method.name}: size of {part}", size)
        for part, size in method.sizes().items()
    }
    return found | {"size_bytes.total": sum(found.values())} if found else {}


def _costs_of_training(method: Method) -> dict[str, float]:
    """Seconds and peak memory of the training, and the seconds of compiling if that was needed."""
    found: dict[str, float] = {
        "train_s": method.train_s,
        "train_peak_bytes": getattr(method, "train_peak_bytes", math.nan),
    }
    if seconds := getattr(method, "compile_s", 0.0):
        found["compile_s"] = seconds
    for name, value in found.items():
        if value < 0 or value == math.inf:
            raise unexpected(f"{method.name}: {name}", "0 or more, or NaN: not known", value)
    return found


def _doubted_times(records: Sequence[FrameRecord]) -> str:
    """Why reported times may be of another unit, or leave work out; empty if nothing says so."""
    told_ms = np.array([record.total_ns / 1e6 for record in records])
    here_ms = np.array([((of.wall_ns or 0) - of.transfer_ns) / 1e6 for of in records])
    doubted = (told_ms < FEW * here_ms) & (here_ms - told_ms > NOTABLE_MS)
    count = int(doubted.sum())
    often = count > OFTEN * len(records) and (count > 1 or len(records) == 1)
    told, here = float(np.median(told_ms)), float(np.median(here_ms))
    usually = told < FEW * here and here - told > USUAL_MS
    if not often and not usually:
        return ""
    if often:
        first = int(doubted.argmax())
        told, here = told_ms[first], here_ms[first]
    which = f"{count} of {len(records)} frames" if often else "half of the frames"
    return (
        f"of {which} it reports, for example, {told:.3g} ms, by the clock here {here:.3g} ms "
        "passed, without the transfer of the picture: does it report nanoseconds, and all of its "
        "work?"
    )


def _waits(of_frames: Sequence[Counter[CodeLine]]) -> Rows:
    """Where the host waits for the GPU in a steady frame, the most frequent first."""
    return [
        {"waits": count / len(of_frames), "line": line.place, "source": line.source}
        for line, count in sum(of_frames, Counter()).most_common()
    ]


def _render(takes: Sequence[_Take], task: Task, log: Log) -> Neighbours:
    """Warm up, then render the sequence in order, as many rounds as the protocol has; what other
    processes used while it was timed."""
    steps = task.trajectory.steps
    rounds = task.protocol.rounds
    warmup = spread(len(steps), task.protocol.warmup)
    frames = len(takes) * (len(warmup) + rounds * len(steps))
    with torch.no_grad(), log.progress("rendering", frames) as progress:
        _reset(takes)
        for number, take in product(warmup, takes):
            settled = number > 0 or len(warmup) == 1  # in the first, kernels may be compiled
            if settled:
                give_back()  # what compiling has freed
            metered = take.metered(warm=True) if settled else nullcontext()
            camera = moved(steps[number].camera, hairs=-1)
            with metered, take.timed_frame():
                take.method.render(camera, take.clock)
            progress.advance(note="warming up")
        watch = Watch()
        for number in range(rounds):
            _reset(takes)
            if number == 1:
                watch = Watch()
            for index in range(len(steps)):
                first: Tensor | None = None
                for take in takes:
                    picture = _draw(take, task, index, first, hairs=number)
                    first = picture if first is None else first
                    progress.advance(note=take.mean_psnr())
        return watch.seen()


def _reset(takes: Sequence[_Take]) -> None:
    for take in takes:
        with take.called():
            take.method.reset()


def _repeat(take: _Take, task: Task) -> None:
    """Render the frame in the middle of the path twice more, after as many frames before it as the
    method uses: both are the same unless they are random and, of a method without memory, as in the
    path."""
    index = len(task.trajectory.steps) // 2
    method = take.method
    before = max(0, index - method.memory)
    again = []
    for _ in range(2):
        method.reset()
        for step in task.trajectory.steps[before : index + 1]:
            with torch.no_grad():
                frame = method.render(lent(step.camera), NullProbe())
        again.append(taken(frame, step.camera, method.name, index).rgb.cpu())
    if _differ(*again):
        take.doubts.append("it renders one view in several ways: its pictures are random")
    elif not method.memory and _differ(again[0], take.middle):
        take.doubts.append("its pictures depend on the frames before, though its `memory` is 0")


def _differ(one: Tensor, other: Tensor) -> bool:
    """Whether two pictures differ by more than a level of 8 bits somewhere."""
    return bool((one - other).abs().max() > 1 / 255)


def _draw(take: _Take, task: Task, index: int, first: Tensor | None, *, hairs: int) -> Tensor:
    """Render the frame `index` with a method and return its picture.

    In the round whose camera is where it should be, 0 `hairs` away, it is also scored, and compared
    with the picture of the `first` method, if there is one. The method is not told of cuts, because
    a user who steers a camera does not announce a jump.
    """
    method = take.method
    step = task.trajectory.steps[index]
    camera = moved(step.camera, hairs) if hairs else lent(step.camera)
    counting = task.protocol.waits and not hairs
    counted_waits = device_waits() if counting else nullcontext()
    with counted_waits as waits, take.metered(), take.timed_frame():
        frame = method.render(camera, take.clock)
    with _named(method, take.several):
        frame = taken(frame, step.camera, method.name, index)
        if take.timed_here and frame.rgb.device.type != take.clock.device.type:
            raise unexpected(
                f"{method.name}: frame {index}: rgb",
                f"a tensor on {take.clock.device.type}, whose work the clock waits for, as the "
                "method's settings() say",
                frame.rgb.device,
            )
    if hairs:
        return frame.rgb
    cold = task.trajectory.preceding[index] < method.memory
    if waits is not None and not cold:
        take.waits.append(waits)
    _score(take, task, index, frame, first, COLD if cold else STEADY)
    return frame.rgb


def _score(
    take: _Take, task: Task, index: int, frame: Frame, first: Tensor | None, phase: str
) -> None:
    """Score the frame `index` of a method and, if the protocol compares, hold it against the
    picture of the `first` method, if there is one."""
    step = task.trajectory.steps[index]
    protocol = task.protocol
    if index == len(task.trajectory.steps) // 2:
        take.middle = frame.rgb.cpu()
    figures: dict[str, Any] = {"frame": index, "phase": phase}
    scored = step.truth is not None
    truth: Tensor | None = None
    mask: Tensor | None = None
    if step.truth is not None:
        split = task.scene.splits[task.trajectory.split]
        figures["name"] = split.names[step.truth]
        truth = split.images[step.truth]
        mask = split.mask(step.truth)
    elif protocol.flicker == "exact" and task.scene.exact is not None:
        truth = task.scene.exact(step.camera)
    if protocol.compared and phase == STEADY and scored:
        shown = protocol.rounded(frame.rgb).cpu().double()
        other = shown if first is None else protocol.rounded(first).cpu().double()
        apart = shown - other
        take.apart.append((apart.square().mean().item(), apart.abs().max().item()))
    scores = take.scoring.score(
        index,
        frame.rgb,
        truth,
        scored=scored,
        cut=step.cut,
        camera=step.camera,
        depth=frame.depth,
        mask=mask,
    )
    take.rows.append(figures | scores)


def _costs(record: FrameRecord) -> dict[str, float]:
    return {
        "frame_ms": record.total_ns / 1e6,
        **({} if record.wall_ns is None else {"wall_ms": record.wall_ns / 1e6}),
        **{f"stage_ms.{name}": ns / 1e6 for name, ns in record.stages_ns.items()},
        **{f"work.{name}": done for name, done in record.done.items()},
        **{f"work.{name}.dense": dense for name, dense in record.dense.items()},
    }


def _frame_table(table: Rows, scores: Sequence[str]) -> pd.DataFrame:
    """One row per frame; missing stages and counters are 0, missing scores NaN."""
    frames = pd.DataFrame(table)
    touched = [name for name in map(str, frames) if name.startswith(("stage_ms.", "work."))]
    touched.sort(key=lambda name: (name.startswith("work."), name == "stage_ms.other"))
    times = [name for name in ("frame_ms", "wall_ms") if name in frames]
    columns = ["frame", "name", "phase", *scores, *times, *touched]
    return frames.reindex(columns=columns).fillna(dict.fromkeys(touched, 0))

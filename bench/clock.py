"""The clock and the counters of a measurement."""

import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from numbers import Integral
from typing import Any

import torch
from torch import Tensor

from bench.errors import SteerbenchError, unexpected
from bench.types import DEVICE

MOST = 2**63  # from here on a number is none that was measured

OTHER = "other"  # the stage that gets the time of a frame outside any stage


@dataclass(frozen=True)
class FrameRecord:
    """The times and the work of one frame."""

    stages_ns: dict[str, int]  # of each stage and `other`; "outer/inner" is no part of "outer"
    done: dict[str, int]  # units of work by counter
    dense: dict[str, int]  # the work of a method that skips nothing, of counters that report it
    wall_ns: int | None = None  # by the clock here, if another process told the stages' times
    peak_bytes: int | None = None  # of the memory of that process, if it told
    transfer_ns: int = 0  # of the wall time, while the picture arrived

    @property
    def total_ns(self) -> int:
        """Time from the beginning to the end of the frame: the sum of all stages."""
        return sum(self.stages_ns.values())


class StageClock:
    """The probe of a measurement: charges every nanosecond of a frame to exactly one stage.

    The clock is read when a stage begins or ends, after the device has finished its work. The time
    since the last reading goes to the innermost open stage, so that the stages and `other` add up
    to the frame by construction. Without `stages` the clock is read, and the GPU waited for, only
    at the beginning and end of a frame, and all its time is `other`.
    """

    def __init__(
        self, device: str, clock: Callable[[], int] = time.perf_counter_ns, *, stages: bool = True
    ) -> None:
        self.frames: list[FrameRecord] = []
        # What is not a device of torch is one of another process.
        self.device = torch.device(device if DEVICE.fullmatch(device) else "cpu")
        self._clock, self._stages = clock, stages
        self._open: list[str] | None = None  # names of the open stages; None outside a frame
        self._last = 0
        self._begin()

    @contextmanager
    def frame(self) -> Iterator[None]:
        """Measure one frame; its record is kept unless the body raises."""
        if self._open is not None:
            raise RuntimeError("a frame may not begin inside a frame")
        self._begin()
        self._open = []
        self._last = self._now()
        try:
            yield
            self._charge()
            done = {name: counted(name, int(units)) for name, units in self._done.items()}
            record = FrameRecord(dict(self._ns), done, dict(self._dense))
            if self._told:
                record = replace(record, wall_ns=record.total_ns, **self._told)
            self.frames.append(record)
        finally:
            self._open = None

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time a stage of the current frame; see `bench.types.Probe`."""
        if self._open is None:
            raise RuntimeError(f"stage {name!r} was entered outside a frame")
        if name == OTHER:
            raise ValueError(f"a stage may not be named {OTHER!r}: that is the remainder")
        if not self._stages:
            yield
            return
        self._charge()
        self._open.append(name)
        try:
            yield
        finally:
            self._charge()
            self._open.pop()

    def count(self, name: str, done: int | Tensor, dense: int | None = None) -> None:
        self._done[name] += done if isinstance(done, Tensor) else counted(name, done)
        if dense is not None:
            self._dense[name] += counted(f"{name}.dense", dense)

    def report(
        self,
        ns: int,
        stages_ns: Mapping[str, int],
        peak_bytes: int | None = None,
        transfer_ns: int = 0,
    ) -> None:
        """Take the times of another process's clock; see `bench.types.Probe`."""
        self._charge()
        wall_ns = sum(self._ns.values())
        counted("transfer_ns", transfer_ns)
        for name, part in stages_ns.items():
            counted(f"ns of the stage {name}", part)
        if not counted("ns", ns):
            raise unexpected("ns", "the time of a frame, 1 or more", ns)
        if peak_bytes is not None:
            counted("peak_bytes", peak_bytes)
        if self._told:
            raise SteerbenchError("the time of a frame was reported twice: expected it once")
        if ns > wall_ns:
            passed = f"at most the {wall_ns} ns by the clock here since the frame began"
            raise unexpected("ns", passed, ns)
        stages = {name: of for name, of in stages_ns.items() if name != OTHER and self._stages}
        stages[OTHER] = ns - sum(stages.values())
        if stages[OTHER] < 0:
            raise unexpected("ns of the stages", f"at most {ns} in all", stages_ns)
        self._told.update(stages_ns=stages, peak_bytes=peak_bytes, transfer_ns=transfer_ns)

    def _begin(self) -> None:
        self._ns: defaultdict[str, int] = defaultdict(int, {OTHER: 0})
        self._done: defaultdict[str, int | Tensor] = defaultdict(int)
        self._dense: defaultdict[str, int] = defaultdict(int)
        self._told: dict[str, Any] = {}  # what another process has told of this frame

    def _now(self) -> int:
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
        return self._clock()

    def _charge(self) -> None:
        now = self._now()
        self._ns["/".join(self._open or ()) or OTHER] += now - self._last
        self._last = now


def counted(what: str, number: Any) -> int:
    """`number` as a plain int; SteerbenchError unless it is whole, 0 or more, and below 2^63."""
    whole = isinstance(number, Integral) and not isinstance(number, bool)
    if whole and 0 <= number < MOST:
        return int(number)
    got = "one beyond" if whole and abs(number) >= MOST else repr(number)
    raise unexpected(what, "a whole number from 0 on, below 2^63", got)


def times_ms(
    calls: Sequence[Callable[[], object]], repeats: int, device: str = "cpu"
) -> list[list[float]]:
    """Milliseconds of `repeats` runs of each call, in turns: a drifting clock affects all alike."""
    clocks = [StageClock(device) for _ in calls]
    for _ in range(repeats):
        for clock, call in zip(clocks, calls, strict=True):
            with clock.frame():
                call()
    return [[frame.total_ns / 1e6 for frame in clock.frames] for clock in clocks]

"""The clock, the counters and the memory meter of a measurement."""

from __future__ import annotations

import re
import resource
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from bench.allocator import give_back

OTHER = "other"
"""The stage that gets the time of a frame outside any stage."""


@dataclass(frozen=True)
class FrameRecord:
    """The times and the work of one frame.

    Attributes:
        stages_ns: time of each stage and of `other`, without nested stages: a stage inside another
            is named "outer/inner", and its time is not part of "outer".
        done: units of work by counter.
        dense: the work of a method that skips nothing, for the counters that report it.
    """

    stages_ns: dict[str, int]
    done: dict[str, int]
    dense: dict[str, int]

    @property
    def total_ns(self) -> int:
        """Time from the beginning to the end of the frame: the sum of all stages."""
        return sum(self.stages_ns.values())


def p99_to_p50(frames: Sequence[FrameRecord]) -> float:
    """How much longer the slowest frames take: 99th percentile of frame time over the median."""
    middle, last = np.percentile([frame.total_ns for frame in frames], (50, 99))
    return float(last / middle)


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
        self._device = torch.device(device)
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
            done = {name: int(units) for name, units in self._done.items()}
            self.frames.append(FrameRecord(dict(self._ns), done, dict(self._dense)))
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
        """Add work to the current frame; see `bench.types.Probe`."""
        self._done[name] += done
        if dense is not None:
            self._dense[name] += dense

    def _begin(self) -> None:
        self._ns: defaultdict[str, int] = defaultdict(int, {OTHER: 0})
        self._done: defaultdict[str, int | Tensor] = defaultdict(int)
        self._dense: defaultdict[str, int] = defaultdict(int)

    def _now(self) -> int:
        if self._device.type == "cuda":
            torch.cuda.synchronize(self._device)
        return self._clock()

    def _charge(self) -> None:
        now = self._now()
        self._ns["/".join(self._open or ()) or OTHER] += now - self._last
        self._last = now


def times_ms(
    calls: Sequence[Callable[[], object]], repeats: int, device: str = "cpu"
) -> list[list[float]]:
    """Milliseconds of `repeats` runs of each call.

    The calls take turns, so that a drifting clock affects all alike.
    """
    clocks = [StageClock(device) for _ in calls]
    for _ in range(repeats):
        for clock, call in zip(clocks, calls, strict=True):
            with clock.frame():
                call()
    return [[frame.total_ns / 1e6 for frame in clock.frames] for clock in clocks]


class MemoryMeter:
    """Measures peak memory over regions of code: `with meter: ...`, as often as needed.

    Memory freed earlier, say in a training, is first returned to the system.

    Attributes:
        peak_bytes: the highest peak so far; 0 before the first region.
        of_process: whether the memory of the whole process is measured, including what other code
            keeps.
        source: what was read, in words. It must be reported with the figure: memory of a device, of
            a process while it renders, and of a process since its start are different things.
    """

    def __init__(self, device: str) -> None:
        self.peak_bytes = 0
        self._device = torch.device(device)
        self.of_process = self._device.type != "cuda"
        give_back()
        if not self.of_process:
            self.source = "peak allocated on the device while rendering"
        elif _reset_high_water_mark():
            self.source = "peak resident memory of the process while rendering"
        else:
            self.source = "peak resident memory of the process since it began"

    def __enter__(self) -> None:
        if self.of_process:
            _reset_high_water_mark()
        else:
            torch.cuda.reset_peak_memory_stats(self._device)

    def __exit__(self, *exception: object) -> None:
        of_device = torch.cuda.max_memory_allocated
        peak = _process_peak_bytes() if self.of_process else of_device(self._device)
        self.peak_bytes = max(self.peak_bytes, peak)


def _reset_high_water_mark() -> bool:
    """Reset the peak resident memory of this process; False if the system cannot do that."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return False
    return True


def _process_peak_bytes() -> int:
    """Peak resident memory since the last reset, or since the process started."""
    status = Path("/proc/self/status")
    peak_kib = re.search(r"VmHWM:\s*(\d+)", status.read_text() if status.exists() else "")
    if peak_kib:  # some sandboxes have no such line
        return int(peak_kib[1]) * 1024
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024

"""The clock, the counters and the memory meter of a measurement, and where it waits for a GPU."""

from __future__ import annotations

import linecache
import re
import resource
import sys
import time
import traceback
import warnings
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import dropwhile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from bench.allocator import give_back
from bench.errors import Unavailable
from bench.types import DEVICE

OTHER = "other"  # the stage that gets the time of a frame outside any stage
TORCH = str(Path(torch.__file__).parent)
ROOT = f"{Path(__file__).parent.parent}/"


@dataclass(frozen=True)
class FrameRecord:
    """The times and the work of one frame."""

    stages_ns: dict[str, int]  # of each stage and `other`; "outer/inner" is no part of "outer"
    done: dict[str, int]  # units of work by counter
    dense: dict[str, int]  # the work of a method that skips nothing, of counters that report it
    wall_ns: int | None = None  # by the clock here, until another process told the stages' times
    peak_bytes: int | None = None  # of the memory of that process, if it told

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
        self._device = _seen_here(device)
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
            record = FrameRecord(dict(self._ns), done, dict(self._dense))
            self.frames.append(replace(record, **self._told))
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
        self._done[name] += done
        if dense is not None:
            self._dense[name] += dense

    def report(self, ns: int, stages_ns: Mapping[str, int], peak_bytes: int | None = None) -> None:
        """Take the times of another process's clock; see `bench.types.Probe`."""
        self._charge()
        stages = {name: of for name, of in stages_ns.items() if name != OTHER and self._stages}
        stages[OTHER] = ns - sum(stages.values())
        self._told.update(stages_ns=stages, wall_ns=sum(self._ns.values()), peak_bytes=peak_bytes)

    def _begin(self) -> None:
        self._ns: defaultdict[str, int] = defaultdict(int, {OTHER: 0})
        self._done: defaultdict[str, int | Tensor] = defaultdict(int)
        self._dense: defaultdict[str, int] = defaultdict(int)
        self._told: dict[str, Any] = {}  # what another process has told of this frame

    def _now(self) -> int:
        if self._device.type == "cuda":
            torch.cuda.synchronize(self._device)
        return self._clock()

    def _charge(self) -> None:
        now = self._now()
        self._ns["/".join(self._open or ()) or OTHER] += now - self._last
        self._last = now


def _seen_here(device: str) -> torch.device:
    """The device of that name; the CPU for what is not one of torch, but of another process."""
    return torch.device(device if DEVICE.fullmatch(device) else "cpu")


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


class MemoryMeter:
    """Measures peak memory over regions of code: `with meter: ...`, as often as needed.

    `source`, what was read, must be reported with the figure: memory of a device, of a process
    while it renders, and of a process since its start are different things.
    """

    def __init__(self, device: str) -> None:
        self.peak_bytes = 0  # the highest so far
        self._device = _seen_here(device)
        self.of_process = self._device.type != "cuda"  # with all that other code keeps
        give_back()  # what was freed earlier, say in a training
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
    status = Path("/proc/self/status")
    peak_kib = re.search(r"VmHWM:\s*(\d+)", status.read_text() if status.exists() else "")
    if peak_kib:  # some sandboxes have no such line
        return int(peak_kib[1]) * 1024
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


class Line(NamedTuple):
    path: str
    number: int

    @property
    def place(self) -> str:
        """File and line number; the path is relative to the repository if the file is inside it."""
        return f"{self.path.removeprefix(ROOT)}:{self.number}"

    @property
    def source(self) -> str:
        return linecache.getline(*self).strip()


@contextmanager
def device_waits() -> Iterator[Counter[Line]]:
    """Count how often the host waits for the GPU inside the context, by the line that caused it.

    Torch reports the waits (`torch.cuda.set_sync_debug_mode`), except explicit synchronisation as
    by a clock. Raises Unavailable if there is no GPU.
    """
    if not torch.cuda.is_available():
        raise Unavailable("to count how often the host waits for the device, a GPU is needed")
    waits: Counter[Line] = Counter()

    def note(message, category, filename, lineno, file=None, line=None):
        if "synchronizing CUDA operation" in str(message):
            # The innermost line outside torch, from the line outwards that the warning names.
            warned = Line(filename, lineno)
            lines = (Line(f.f_code.co_filename, n) for f, n in traceback.walk_stack(None))
            outwards = dropwhile(lambda line: line != warned, lines)
            waits[next((x for x in outwards if not x.path.startswith(TORCH)), warned)] += 1
        else:
            show(message, category, filename, lineno, file, line)

    before = torch.cuda.get_sync_debug_mode()
    with warnings.catch_warnings():
        warnings.filterwarnings("always", "called a synchronizing CUDA operation")
        show, warnings.showwarning = warnings.showwarning, note
        torch.cuda.set_sync_debug_mode("warn")
        try:
            yield waits
        finally:
            torch.cuda.set_sync_debug_mode(before)

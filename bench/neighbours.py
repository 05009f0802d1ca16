"""Measures how busy other processes keep the machine, from the kernel's accounting (psutil)."""

import math
import os
import time
from contextlib import suppress
from typing import NamedTuple

import psutil

NOTABLE_SHARE = 0.1  # of the cores: if other processes use more, times deserve a warning
SHORTEST = 0.5
"""Seconds. The kernel counts in hundredths of a second per core, so that over a shorter time the
rounding alone is a fifth of `NOTABLE_SHARE` or more."""


class Neighbours(NamedTuple):
    """What other processes used."""

    busy: float  # cores on average; in a virtual machine, with what the host took (steal time)
    cores: int
    seconds: float = math.inf
    exclusive: bool = True  # whether no run that waits for its turn could train or measure then

    @property
    def notable(self) -> bool:
        return self.seconds >= SHORTEST and self.busy > NOTABLE_SHARE * self.cores

    def __str__(self) -> str:
        text = f"other programs kept {self.busy:.1f} of {self.cores} cores busy"
        return text if self.exclusive else f"{text}; not timed alone (exclusive=false)"


class Watch:
    def __init__(self) -> None:
        self._begin = _seconds()

    def seen(self) -> Neighbours:
        passed, busy, own = (a - b for a, b in zip(_seconds(), self._begin, strict=True))
        others = max(busy - own, 0.0) / passed if passed > 0 else 0.0
        return Neighbours(others, psutil.cpu_count() or 1, passed)


def _seconds() -> tuple[float, float, float]:
    """Seconds: of a monotonic clock, of work on all cores, and of work of this process and its
    children."""
    spent = psutil.cpu_times()._asdict()
    # `user` and `nice` already include the time of guests.
    none = ("idle", "iowait", "guest", "guest_nice")
    busy = sum(seconds for name, seconds in spent.items() if name not in none)
    return time.monotonic(), busy, time.process_time() + _of_children()


def _of_children() -> float:
    """Seconds of work of the processes that this one has started, and of theirs, also if ended."""
    seconds = sum(os.times()[2:4])
    for process in psutil.Process().children(recursive=True):
        with suppress(psutil.NoSuchProcess):  # one that has just ended
            seconds += sum(process.cpu_times()[:4])
    return seconds

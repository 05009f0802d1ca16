"""How busy other processes keep the machine, from the kernel's own accounts: psutil."""

from __future__ import annotations

import math
import time
from typing import NamedTuple

import psutil

NOTABLE_SHARE = 0.1
"""Of the cores: times that were measured beside more than that are worth a warning."""
SHORTEST = 0.5
"""Seconds: the kernel counts work in hundredths of a second, a core a count, so that in a shorter
time a fifth of `NOTABLE_SHARE` and more is rounding."""


class Neighbours(NamedTuple):
    """Cores that other processes kept busy on average, of how many, in how many seconds; a virtual
    machine counts what its host took away."""

    busy: float
    cores: int
    seconds: float = math.inf

    @property
    def notable(self) -> bool:
        """Whether they are worth a warning."""
        return self.seconds >= SHORTEST and self.busy > NOTABLE_SHARE * self.cores

    def __str__(self) -> str:
        return f"other programs kept {self.busy:.1f} of {self.cores} cores busy"


class Watch:
    """Counts from its making on."""

    def __init__(self) -> None:
        self._begin = _seconds()

    def seen(self) -> Neighbours:
        """What other processes did since then."""
        spans = [now - then for now, then in zip(_seconds(), self._begin, strict=True)]
        passed, busy, own = spans
        others = max(busy - own, 0.0) / passed if passed > 0 else 0.0
        return Neighbours(others, psutil.cpu_count() or 1, passed)


def _seconds() -> tuple[float, float, float]:
    """Time passed, work of all cores, and work of this process."""
    spent = psutil.cpu_times()._asdict()
    # A guest's time is in `user` and `nice`, too.
    none = ("idle", "iowait", "guest", "guest_nice")
    busy = sum(seconds for name, seconds in spent.items() if name not in none)
    return time.monotonic(), busy, time.process_time()

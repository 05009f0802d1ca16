"""Memory: its peak while something runs, and whether freed memory is kept or given back.

A training step allocates and frees 50 MB of activations. If this memory is returned each time, some
12,000 pages must be mapped and cleared again. So glibc is told to keep it; with other C libraries
`keep_freed` and `give_back` do nothing.
"""

import ctypes
import re
import resource
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

M_TRIM_THRESHOLD, M_MMAP_MAX, M_ARENA_MAX = -1, -4, -8  # of malloc.h


def keep_freed() -> None:
    """Keep memory that is freed from now on, for later allocations by any thread."""
    if mallopt := _of_libc("mallopt"):
        mallopt(M_MMAP_MAX, 0)  # a block with a mapping of its own is returned at once
        mallopt(M_TRIM_THRESHOLD, 2**31 - 1)
        mallopt(M_ARENA_MAX, 1)  # other arenas would still return freed memory


def give_back() -> None:
    """Return all memory freed so far to the system."""
    if malloc_trim := _of_libc("malloc_trim"):
        malloc_trim(0)


def _of_libc(name: str) -> Callable[..., int] | None:
    return getattr(ctypes.CDLL(None), name, None) if sys.platform == "linux" else None


class MemoryMeter:
    """Measures peak memory over regions of code: `with meter: ...`, as often as needed.

    `source`, what was read, must be reported with the figure: memory of a device, of a process
    while it renders, and of a process since its start are different things.
    """

    def __init__(self, device: str) -> None:
        self.peak_bytes = 0  # the highest so far
        # With all that other code keeps; also for a device of another process.
        self.of_process = not re.fullmatch(r"cuda(:\d+)?", device)
        give_back()  # what was freed earlier, say in a training
        self._reset: Callable[[], object] = _reset_high_water_mark
        self._peak: Callable[[], int] = _process_peak_bytes
        if self.of_process:
            since = "while rendering" if self._reset() else "since it began"
            self.source = f"peak resident memory of the process {since}"
        else:
            import torch  # not at the top: `keep_freed` is called before it is loaded

            self._reset = partial(torch.cuda.reset_peak_memory_stats, device)
            self._peak = partial(torch.cuda.max_memory_allocated, device)
            self.source = "peak allocated on the device while rendering"

    def __enter__(self) -> None:
        self._reset()

    def __exit__(self, *exception: object) -> None:
        self.look()

    def look(self) -> int:
        """The highest peak so far, also within a region."""
        self.peak_bytes = max(self.peak_bytes, self._peak())
        return self.peak_bytes


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

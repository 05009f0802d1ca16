"""Tells glibc to keep freed memory for the next step, or to give it back to the system.

A training step allocates and frees 50 MB of activations. Given back each time, they are some 12,000
pages that must be mapped and cleared again. With another C library nothing happens here.
"""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Callable

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD, M_ARENA_MAX = -1, -3, -8
"""Names of parameters in malloc.h."""

LARGEST_KEPT = 32 << 20
"""Bytes of the largest piece that is kept, the most that glibc allows."""


def keep_freed() -> None:
    """Keep what is freed from now on, for the next allocation of any thread."""
    if mallopt := _of_libc("mallopt"):
        mallopt(M_MMAP_THRESHOLD, LARGEST_KEPT)
        mallopt(M_TRIM_THRESHOLD, 2**31 - 1)
        mallopt(M_ARENA_MAX, 1)  # other arenas give freed memory back all the same


def give_back() -> None:
    """Give back what was freed until now."""
    if malloc_trim := _of_libc("malloc_trim"):
        malloc_trim(0)


def _of_libc(name: str) -> Callable[..., int] | None:
    return getattr(ctypes.CDLL(None), name, None) if sys.platform == "linux" else None

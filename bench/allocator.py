"""Tells glibc to keep freed memory for the next step, or to return it to the system.

A training step allocates and frees 50 MB of activations. If this memory is returned each time, some
12,000 pages must be mapped and cleared again. With other C libraries these functions do nothing.
"""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Callable

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

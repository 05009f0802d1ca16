"""Processes that measure or train: how they are set up, and pools of them."""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager

from bench.allocator import keep_freed


def set_up() -> None:
    """Set what torch reads when it is loaded, and what the memory allocator does.

    Two thread pools take turns here, torch's and numba's. A pool that spins while idle blocks cores
    that the other needs; one that sleeps at once must be woken a thousand times per step. So let it
    spin for some ten microseconds. Large tensors lie on pages of 2 MB: fewer pages to map, and
    fewer addresses to look up.
    """
    os.environ.setdefault("GOMP_SPINCOUNT", "20000")
    os.environ.setdefault("THP_MEM_ALLOC_ENABLE", "1")
    keep_freed()


@contextmanager
def processes(count: int) -> Iterator[ProcessPoolExecutor]:
    """A pool of `count` processes that end with this one, however it ends.

    They are spawned, because threads do not survive a fork: for work on which threads would wait
    for Python's lock.
    """
    spawned = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(count, mp_context=spawned, initializer=_begin)
    try:
        yield pool
    finally:
        pool.shutdown(cancel_futures=True)


def _begin() -> None:
    set_up()
    parent = multiprocessing.parent_process()
    assert parent is not None

    def wait() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()

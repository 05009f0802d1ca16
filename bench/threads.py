"""Threads: how many torch uses per operation, and work on many items with all cores."""

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

import torch

from bench.types import Log

Item = TypeVar("Item")
Result = TypeVar("Result")

WORKERS = min(os.cpu_count() or 1, 8)  # more threads would mostly wait for Python's GIL


@contextmanager
def torch_threads(count: int | None) -> Iterator[None]:
    """Run each torch operation on `count` threads inside the context; None: leave it unchanged.

    Use 1 for many small operations: nested thread pools compete for the cores, and on a busy
    machine even a single pool mostly waits for its slowest thread.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(count or before)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def in_parallel(
    work: Callable[[Item], Result], items: Sequence[Item], label: str, log: Log
) -> list[Result]:
    """[work(item) for item in items], in parallel with a progress bar; the first error stops it."""
    results = []
    pool = ThreadPoolExecutor(WORKERS)
    with torch_threads(1), log.progress(label, len(items)) as bar, pool:
        for result in pool.map(work, items):  # after an error, waiting items are not started
            results.append(result)
            bar.advance()
    return results

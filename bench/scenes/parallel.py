"""Runs a function on many items, on all cores."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from bench.threads import torch_threads
from bench.types import Log

Item = TypeVar("Item")
Result = TypeVar("Result")

WORKERS = min(os.cpu_count() or 1, 8)
"""Threads at work; beyond eight they would wait for Python's lock more than they compute."""


def in_parallel(
    work: Callable[[Item], Result], items: Sequence[Item], label: str, log: Log
) -> list[Result]:
    """[work(item) for item in items] under a progress bar; the first fault ends it."""
    with (
        torch_threads(1),
        log.progress(label, len(items)) as bar,
        ThreadPoolExecutor(WORKERS) as pool,
    ):
        futures = [pool.submit(work, item) for item in items]
        results = []
        try:
            for future in futures:
                results.append(future.result())
                bar.advance()
        finally:  # after a fault, what still waits is not begun
            pool.shutdown(wait=False, cancel_futures=True)
    return results

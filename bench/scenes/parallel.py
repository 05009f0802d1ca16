"""Applies a function to many items, on all cores."""

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
"""Number of threads; more than eight would mostly wait for Python's GIL."""


def in_parallel(
    work: Callable[[Item], Result], items: Sequence[Item], label: str, log: Log
) -> list[Result]:
    """[work(item) for item in items], in parallel with a progress bar; the first error stops it."""
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
        finally:  # after an error, waiting items are not started
            pool.shutdown(wait=False, cancel_futures=True)
    return results

"""One kind of work on many things, on all cores."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

import torch

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
        one_thread_each(),
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


@contextmanager
def one_thread_each() -> Iterator[None]:
    """Keep each of torch's operations on the thread that calls it.

    For many small operations: pools inside a pool fight for the cores, and on a busy machine even
    a single pool spends most of its time waiting for its slowest thread.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)

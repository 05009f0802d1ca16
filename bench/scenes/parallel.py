"""Applies a function to many items, on all cores."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, TypeVar

import torch

from bench.threads import torch_threads
from bench.types import Log, SteerbenchError

Item = TypeVar("Item")
Result = TypeVar("Result")

WORKERS = min(os.cpu_count() or 1, 8)
"""Number of threads or processes; more than eight threads would mostly wait for Python's GIL."""


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


def in_processes(
    work: Callable[[Item], Result], items: Sequence[Item], label: str, log: Log
) -> list[Result]:
    """`in_parallel` for work of many small operations, of which threads wait for Python's GIL.

    The processes are copies of this one, with one thread each; results are pickled.

    Raises:
        SteerbenchError: a process was killed.
    """
    from torch.utils.data import DataLoader  # takes a moment

    with warnings.catch_warnings():
        # That there are fewer cores, and, since Python 3.12, that threads do not exist in copies.
        warnings.simplefilter("ignore")
        loader: Any = DataLoader(
            _Work(work, items),  # type: ignore[arg-type]  # it has all that is used of a Dataset
            batch_size=None,
            num_workers=min(WORKERS, max(len(items), 1)),
            multiprocessing_context="fork",
            generator=torch.Generator(),  # otherwise a number of the global one is used up
        )
        results = iter(loader)
    found = []
    with log.progress(label, len(items)) as bar:
        for result in _received(results, label):
            if isinstance(result, _Failed):
                raise result.error
            found.append(result)
            bar.advance()
    return found


def _received(results: Iterator[Result], label: str) -> Iterator[Result]:
    try:
        yield from results
    except RuntimeError as error:  # of the DataLoader: what the work raises comes as a result
        raise SteerbenchError(f"{label}: a process was killed; is there enough memory?") from error


@dataclass(frozen=True)
class _Failed:
    error: Exception


@dataclass(frozen=True)
class _Work:
    work: Callable[[Any], Any]
    items: Sequence[Any]

    def __len__(self) -> int:
        return len(self.items)

    def __getitem__(self, index: int) -> Any:
        try:
            return self.work(self.items[index])
        except Exception as error:  # as it is; a DataLoader would make a traceback of its message
            return _Failed(error)

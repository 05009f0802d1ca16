"""Sets how many threads torch uses for an operation."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def torch_threads(count: int | None) -> Iterator[None]:
    """Compute each of torch's operations on `count` threads, and afterwards on as many as before;
    with None, on as many as before all along.

    One, for many small operations: pools inside a pool fight for the cores, and on a busy machine
    even a single pool spends most of its time waiting for its slowest thread.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(count or before)
    try:
        yield
    finally:
        torch.set_num_threads(before)

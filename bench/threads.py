"""Sets how many threads torch uses per operation."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch


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

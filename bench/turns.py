"""The order in which several methods render the same frames, so that their times compare."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TypeVar

T = TypeVar("T")

BLOCK = 1
"""Consecutive frames that each method renders before the next method does.

The more, the longer the caches hold one model; the fewer, the less a drifting clock favours one.
"""


def in_turns(methods: Sequence[T], frames: int, block: int = BLOCK) -> Iterator[tuple[int, T]]:
    """Every frame with every method: `block` frames by each, then the next `block` frames."""
    for begin in range(0, frames, block):
        for method in methods:
            for frame in range(begin, min(begin + block, frames)):
                yield frame, method

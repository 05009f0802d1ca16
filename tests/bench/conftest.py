"""A log that keeps what it was told."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest


class RememberingLog:
    """`messages` are the lines said, `done` the steps counted by all progress bars."""

    def __init__(self) -> None:
        self.messages: list[str] = []
        self.done = 0

    def info(self, message: str) -> None:
        self.messages.append(message)

    @contextmanager
    def progress(self, label: str, total: int) -> Iterator[RememberingLog]:
        yield self

    def advance(self, steps: int = 1, note: str = "") -> None:
        self.done += steps


@pytest.fixture
def log() -> RememberingLog:
    return RememberingLog()

"""A log that keeps what it was told; weights that nobody has."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from tests.web import Web


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


@pytest.fixture
def publisher(monkeypatch, tmp_path, web) -> Web:
    """An empty cache, no environment, and a publisher of weights with no file."""
    monkeypatch.setattr("bench.weights.ADDRESS", web.address)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    monkeypatch.delenv("STEERBENCH_WEIGHTS", raising=False)
    return web

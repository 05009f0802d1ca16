"""Data sets that are published for the time of a test."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping

import pytest

from bench import published
from bench.published import Published
from sweeps.commands import scenes


def publish(monkeypatch: pytest.MonkeyPatch, files: Mapping[str, bytes], **where: str) -> Published:
    """A data set of these files by their paths, the only one that is known."""
    data = Published("release", "blender", "free", **where)
    hashes = {name: hashlib.sha256(content).hexdigest() for name, content in files.items()}
    data.__dict__["hashes"] = hashes  # as if they had been read
    for module in (published, scenes):
        monkeypatch.setattr(module, "published", lambda: [data])
    return data

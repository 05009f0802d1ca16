"""What the tests of engines share."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from tests.methods.engines import tensorrt_double


@pytest.fixture
def folder(tmp_path: Path) -> Callable[[], Path]:
    return lambda: tmp_path


@pytest.fixture
def double(monkeypatch: pytest.MonkeyPatch) -> None:
    """TensorRT and a GPU, both played."""
    monkeypatch.setitem(sys.modules, "tensorrt", tensorrt_double)
    monkeypatch.setattr(tensorrt_double.Builder, "built", 0)
    for name, value in (
        ("is_available", lambda: True),
        ("get_device_name", lambda: "a GPU"),
        ("Stream", tensorrt_double.Stream),
        ("current_stream", tensorrt_double.Stream),
    ):
        monkeypatch.setattr(torch.cuda, name, value)

"""What the tests of engines share."""

import sys
from collections.abc import Callable

import pytest
import torch

from methods.engines import Built
from tests.methods.engines import tensorrt_double


@pytest.fixture
def build(tmp_path, quiet_log) -> Callable[..., Built]:
    """Builds a network with an engine from the inputs of some frames, in a folder."""

    def built(engine, network, samples, folder=""):
        place = tmp_path / folder
        place.mkdir(exist_ok=True)

        def frames():
            assert samples is not None, "the frames are not needed again"
            return samples

        return engine.build(network, frames, lambda: place, quiet_log)

    return built


@pytest.fixture
def double(monkeypatch) -> None:
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

"""Inputs of a network on real frames are recorded once, for every engine."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from bench.console import ConsoleLog
from bench.types import SteerbenchError
from methods.engines import Inputs
from methods.steernerf.training.calibration import kept_inputs

CPU = torch.device("cpu")

FRAMES: list[Inputs] = [
    (torch.full((frame + 1, 2), float(frame)), torch.arange(frame + 1, dtype=torch.int32))
    for frame in range(12)
]
"""More than ten: by name, the eleventh must not come after the first."""


def test_what_was_recorded_is_found_again_in_its_order(
    tmp_path: Path, quiet_log: ConsoleLog
) -> None:
    first = kept_inputs(lambda: tmp_path, lambda: FRAMES, CPU, quiet_log)

    def never() -> list[Inputs]:
        raise AssertionError("they are not recorded again")

    again = kept_inputs(lambda: tmp_path, never, CPU, quiet_log)
    for found in (first, again):
        assert len(found) == len(FRAMES)
        for inputs, wanted in zip(found, FRAMES, strict=True):
            assert all(torch.equal(x, y) for x, y in zip(inputs, wanted, strict=True))
            assert [x.dtype for x in inputs] == [x.dtype for x in wanted]


def test_what_is_found_is_put_on_the_device(tmp_path: Path, quiet_log: ConsoleLog) -> None:
    kept_inputs(lambda: tmp_path, lambda: FRAMES, CPU, quiet_log)
    found = kept_inputs(lambda: tmp_path, lambda: FRAMES, torch.device("meta"), quiet_log)
    assert {x.device.type for inputs in found for x in inputs} == {"meta"}


def test_what_cannot_be_recorded_leaves_nothing(tmp_path: Path, quiet_log: ConsoleLog) -> None:
    def fails() -> list[Inputs]:
        raise ArithmeticError

    with pytest.raises(ArithmeticError):
        kept_inputs(lambda: tmp_path, fails, CPU, quiet_log)
    assert [path.name for path in tmp_path.iterdir() if path.name != "lock"] == []


def test_a_damaged_file_is_named(tmp_path: Path, quiet_log: ConsoleLog) -> None:
    kept_inputs(lambda: tmp_path, lambda: FRAMES, CPU, quiet_log)
    (tmp_path / "inputs.safetensors").write_bytes(b"torn")
    with pytest.raises(SteerbenchError, match=r"inputs\.safetensors: expected the file"):
        kept_inputs(lambda: tmp_path, lambda: FRAMES, CPU, quiet_log)

"""Inputs of a network on real frames are recorded once, for every engine."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import cast

import pytest
import torch

from bench.console import ConsoleLog
from bench.types import Scene, SteerbenchError
from methods.engines import Inputs
from methods.steernerf.calibration import Calibration
from methods.steernerf.pipeline import Pipeline
from tests.methods.models import (
    lean_pipeline,
    lean_rendering,
    new_pipeline,
    small_model,
    small_rendering,
)

FRAMES: list[Inputs] = [
    (torch.full((frame + 1, 2), float(frame)), torch.arange(frame + 1, dtype=torch.int32))
    for frame in range(12)
]
"""More than ten: by name, the eleventh must not come after the first."""


def of(scene: Scene, pipeline: Pipeline | None = None, seed: int = 0) -> Calibration:
    return Calibration(pipeline or new_pipeline(), small_rendering(), scene, (0.0, 2.0), seed)


@pytest.fixture
def known(ball_scene: Scene, monkeypatch: pytest.MonkeyPatch) -> Calibration:
    """What it records is `FRAMES`."""
    monkeypatch.setattr(Calibration, "record", lambda self, count, log: FRAMES[:count])
    return of(ball_scene)


def test_what_was_recorded_is_found_again_in_its_order(
    known: Calibration, tmp_path: Path, quiet_log: ConsoleLog, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = known.inputs(len(FRAMES), tmp_path, quiet_log)
    monkeypatch.delattr(Calibration, "record")  # they are not recorded again
    again = known.inputs(len(FRAMES), tmp_path, quiet_log)
    for found in (first, again):
        assert len(found) == len(FRAMES)
        for inputs, wanted in zip(found, FRAMES, strict=True):
            assert all(torch.equal(x, y) for x, y in zip(inputs, wanted, strict=True))
            assert [x.dtype for x in inputs] == [x.dtype for x in wanted]


def test_what_is_found_is_put_on_the_device(
    known: Calibration, tmp_path: Path, quiet_log: ConsoleLog
) -> None:
    class Elsewhere:
        background = torch.zeros(3, device="meta")

    known.inputs(2, tmp_path, quiet_log)
    elsewhere = replace(known, pipeline=cast(Pipeline, Elsewhere()))
    found = elsewhere.inputs(2, tmp_path, quiet_log)
    assert {x.device.type for inputs in found for x in inputs} == {"meta"}


def test_what_cannot_be_recorded_leaves_nothing(
    ball_scene: Scene, tmp_path: Path, quiet_log: ConsoleLog, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*arguments: object) -> list[Inputs]:
        raise ArithmeticError

    monkeypatch.setattr(Calibration, "record", fails)
    with pytest.raises(ArithmeticError):
        of(ball_scene).inputs(1, tmp_path, quiet_log)
    assert [path.name for path in tmp_path.iterdir() if path.name != "lock"] == []


def test_a_damaged_file_is_named(known: Calibration, tmp_path: Path, quiet_log: ConsoleLog) -> None:
    known.inputs(1, tmp_path, quiet_log)
    (tmp_path / "inputs.safetensors").write_bytes(b"torn")
    with pytest.raises(SteerbenchError, match=r"inputs\.safetensors: expected the file"):
        known.inputs(1, tmp_path, quiet_log)


def test_a_frame_is_recorded_behind_as_many_as_the_buffer_holds_and_one_more(
    ball_scene: Scene, quiet_log: ConsoleLog, monkeypatch: pytest.MonkeyPatch
) -> None:
    pipeline, rendered = new_pipeline(small_model(frames=1)), []
    features = Pipeline.features

    def counted(self, view, preceding, *rest):
        rendered.append((view.full.c2w, len(preceding)))
        return features(self, view, preceding, *rest)

    monkeypatch.setattr(Pipeline, "features", counted)
    frames = of(ball_scene, pipeline).record(3, quiet_log)
    assert [preceding for _, preceding in rendered] == 3 * [0, 1, 1]
    train = ball_scene.splits["train"].cameras
    views = [train[place].c2w for place in (0, 8, 16)]
    assert all(map(torch.equal, [c2w for c2w, _ in rendered[2::3]], views))
    assert [inputs.shape for (inputs,) in frames] == 3 * [(1, 2 * 4, 32, 32)]
    assert not torch.equal(frames[0][0], frames[1][0])


def test_of_a_lean_pipeline_only_the_frame_itself_is_recorded(
    ball_scene: Scene, quiet_log: ConsoleLog
) -> None:
    """Not those before it, whose pictures are drawn as well."""
    pipeline = lean_pipeline()
    calibration = Calibration(pipeline, lean_rendering(), ball_scene, (0.0, 2.0), 0)
    frames = calibration.record(3, quiet_log)
    assert [rows.shape[1] for rows, _ in frames] == 3 * [pipeline.renderer.layout.width]


def test_the_seed_decides_the_motions(ball_scene: Scene, quiet_log: ConsoleLog) -> None:
    first, again, other = (of(ball_scene, seed=seed).record(1, quiet_log)[0] for seed in (0, 0, 1))
    assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))
    assert not torch.equal(first[0], other[0])

"""A renderer for any scene: trained on several, written, started from."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file
from torch import Tensor

from bench.console import ConsoleLog
from bench.types import Budget, Log, Scene, SteerbenchError
from methods.steernerf.training.joint import JointTraining
from methods.steernerf.training.patches import Batch
from methods.steernerf_lean import lean_renderer
from methods.steernerf_lean.lean_renderer import LeanRenderer
from methods.steernerf_lean.pretraining import AnyOf, pretrain_renderer
from methods.steernerf_lean.training import LeanStage2
from methods.training import checkpoint
from tests.methods.models import lean_joint, lean_model, small_motion
from tests.methods.trainings import TEACHER

MODEL = lean_model(channels=3, step=4.0)
JOINT = lean_joint(patch=4, motion=small_motion(pool=2, length=2))
BUDGET = Budget("test", steps=40, samples=1024, renderer_steps=8)
RENDERER = partial(LeanRenderer, width=8, blocks=1, init="pretrained")


def train(scenes: list[Scene], output: Path, log: Log, channels: int = 3) -> dict[str, Tensor]:
    model = replace(MODEL, channels=channels)
    stage2 = LeanStage2(model, partial(RENDERER, init="scratch"), JOINT)
    pretrain_renderer(TEACHER, stage2, scenes, BUDGET, output, log)
    return load_file(output)


@pytest.mark.slow
def test_the_weights_of_several_scenes_are_what_a_renderer_starts_from(
    ball_scene: Scene, tmp_path: Path, quiet_log: Log, monkeypatch: pytest.MonkeyPatch
) -> None:
    on_black = replace(ball_scene, name="on black", background=torch.zeros(3), digest="on black")
    output = tmp_path / "new folder" / "lean.safetensors"
    written = train([ball_scene, on_black], output, quiet_log)
    assert checkpoint.read(output)[1] == {"scenes": 2, "steps": BUDGET.renderer_steps}
    assert {weight.dtype for weight in written.values()} == {torch.float16}
    for name in ("enter.weight", "leave.weight", "read.weight", "read.bias"):
        assert written[name].isfinite().all(), name
        assert written[name].any(), name  # the last three were 0 before the training
    monkeypatch.setattr(lean_renderer, "PRETRAINED", output)
    started = RENDERER(3, 4, history=True)
    assert started.network.state_dict().keys() == written.keys()
    for name, weight in started.network.state_dict().items():
        assert torch.equal(weight, written[name].float()), name
    for channels, history in ((6, True), (3, False), (4, False)):
        other = RENDERER(channels, 4, history=history)
        assert torch.equal(other.network.trunk[0].spread, started.network.trunk[0].spread)


@pytest.mark.slow
def test_the_same_training_results_in_the_same_weights(ball_scene: Scene, tmp_path: Path) -> None:
    first, second = (
        train([ball_scene], tmp_path / f"{name}.safetensors", ConsoleLog(tmp_path / name, True))
        for name in ("first", "second")  # logs of their own: nothing is found again
    )
    for name, weight in first.items():
        assert torch.equal(second[name], weight), name


@pytest.mark.parametrize("channels", [4, 6])
def test_features_that_mean_something_else_in_every_scene_are_refused(
    ball_scene: Scene, tmp_path: Path, quiet_log: Log, channels: int
) -> None:
    output = tmp_path / "lean.safetensors"
    with pytest.raises(SteerbenchError, match=rf"channels \(K\) of 3, got {channels}"):
        train([ball_scene], output, quiet_log, channels)
    assert not list(tmp_path.rglob("*.safetensors"))  # nothing was trained before


def test_a_renderer_that_was_trained_on_the_same_scenes_is_found_again(
    ball_scene: Scene, tmp_path: Path, quiet_log: Log, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = train([ball_scene], tmp_path / "first.safetensors", quiet_log)
    monkeypatch.delattr(JointTraining, "advance")
    again = train([ball_scene], tmp_path / "again.safetensors", quiet_log)
    for name, weight in first.items():
        assert torch.equal(again[name], weight), name
    with pytest.raises(AttributeError, match="advance"):  # with other scenes, another training
        train([ball_scene, ball_scene], tmp_path / "other.safetensors", quiet_log)


class Source:
    """Patches of which all that is known is the source they are from."""

    def __init__(self, number: int) -> None:
        self.number = number

    def draw(self, count: int) -> Batch:
        return Batch([], [], torch.full((count,), self.number), torch.zeros(0))


def test_a_batch_is_of_one_source_and_every_source_has_its_turn() -> None:
    def drawn(seed: int) -> list[int]:
        generator = torch.Generator().manual_seed(seed)
        patches = AnyOf([Source(number) for number in range(3)], generator)
        batches = [patches.draw(2).truth.tolist() for _ in range(300)]
        assert all(first == second for first, second in batches)
        return [first for first, _ in batches]

    numbers = drawn(0)
    for number in range(3):
        assert numbers.count(number) == pytest.approx(100, abs=41)  # 5 standard deviations
    assert numbers == drawn(0) != drawn(1)

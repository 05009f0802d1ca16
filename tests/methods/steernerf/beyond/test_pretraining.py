"""A renderer for any scene: trained on several, written, started from."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import torch
from methods.steernerf.method.beyond import lean_renderer as space_to_depth
from safetensors.torch import load_file
from torch import Tensor

from bench.types import Budget, Log, Scene, SteerbenchError
from methods.instant_ngp.stage1 import Setup
from methods.instant_ngp.training import TrainingOptions
from methods.kernels.encode import HashGrid
from methods.steernerf.beyond.lean_renderer import SpaceToDepth
from methods.steernerf.beyond.pretraining import AnyOf, train_generic
from methods.steernerf.options import PipelineOptions
from methods.steernerf.training.joint import JointOptions
from methods.steernerf.training.patches import Batch
from methods.steernerf.training.sequences import MotionOptions
from methods.training import checkpoint

GRID = HashGrid(levels=8, log2_table=12, n_min=8, n_max=64)
SETUP = Setup.resolved(GRID, TrainingOptions(), "bf16", "auto", "cpu", seed=0)
OPTIONS = PipelineOptions(channels=3, frames=2, steps=4)
JOINT = JointOptions(patch=4, motion=MotionOptions(pool=2, length=2))
BUDGET = Budget("test", steps=40, samples=4096, renderer_steps=8)
RENDERER = partial(SpaceToDepth, width=8, blocks=1)


def train(
    scenes: list[Scene], output: Path, log: Log, options: PipelineOptions = OPTIONS
) -> dict[str, Tensor]:
    make = partial(RENDERER, init="scratch")
    folder = output.with_suffix(".stage")
    folder.mkdir(parents=True)
    train_generic(SETUP, options, make, JOINT, scenes, BUDGET, folder, output, log)
    return load_file(output)


def test_the_weights_of_several_scenes_are_what_a_renderer_starts_from(
    ball_scene: Scene, tmp_path: Path, quiet_log: Log, monkeypatch: pytest.MonkeyPatch
) -> None:
    on_black = replace(ball_scene, name="on black", background=torch.zeros(3), digest="on black")
    output = tmp_path / "new folder" / "generic.safetensors"
    written = train([ball_scene, on_black], output, quiet_log)
    assert checkpoint.read(output)[1] == {"scenes": 2, "steps": BUDGET.renderer_steps}
    assert {weight.dtype for weight in written.values()} == {torch.float16}
    for name in ("enter.weight", "leave.weight", "read.weight", "read.bias"):
        assert written[name].isfinite().all(), name
        assert written[name].any(), name  # the last three were 0 before the training
    monkeypatch.setattr(space_to_depth, "GENERIC", output)
    started = RENDERER(3, 2, 4)
    assert started.network.state_dict().keys() == written.keys()
    for name, weight in started.network.state_dict().items():
        assert torch.equal(weight, written[name].float()), name
    for channels, frames, history in ((6, 2, True), (3, 0, False), (4, 1, False)):
        other = RENDERER(channels, frames, 4, history=history)
        assert torch.equal(other.network.trunk[0].spread, started.network.trunk[0].spread)


def test_the_same_training_results_in_the_same_weights(
    ball_scene: Scene, tmp_path: Path, quiet_log: Log
) -> None:
    first, second = (
        train([ball_scene], tmp_path / f"{name}.safetensors", quiet_log)
        for name in ("first", "second")
    )
    for name, weight in first.items():
        assert torch.equal(second[name], weight), name


@pytest.mark.parametrize("channels", [4, 6])
def test_features_that_mean_something_else_in_every_scene_are_refused(
    ball_scene: Scene, tmp_path: Path, quiet_log: Log, channels: int
) -> None:
    options, output = replace(OPTIONS, channels=channels), tmp_path / "generic.safetensors"
    with pytest.raises(SteerbenchError, match=rf"channels \(K\) of 3, got {channels}"):
        train([ball_scene], output, quiet_log, options)
    assert not list(tmp_path.rglob("*.safetensors"))  # nothing was trained before


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

"""One training for every step and stop that frames are rendered with."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import pytest
import torch

from bench.console import ConsoleLog
from bench.types import Budget, NullProbe, Scene
from methods.engines.torch_engine import TorchEngine
from methods.instant_ngp.training import TrainingOptions
from methods.kernels.encode import HashGrid
from methods.steernerf.beyond.lean_renderer import SpaceToDepth
from methods.steernerf.method import SteerNerf
from methods.steernerf.options import PipelineOptions
from methods.steernerf.training.joint import JointOptions
from methods.steernerf.training.sequences import MotionOptions
from methods.steernerf.untaught import UntaughtOptions, UntaughtSteerNerf

BUDGET = Budget("test", steps=40, samples=4096, renderer_steps=2)


def fitted(
    kind: type[SteerNerf], pipeline: PipelineOptions, scene: Scene, folder: Path
) -> SteerNerf:
    method = kind(
        grid=HashGrid(levels=8, log2_table=12, n_min=8, n_max=64),
        training=TrainingOptions(),
        pipeline=pipeline,
        renderer=partial(SpaceToDepth, width=8, blocks=1, init="scratch"),
        joint=JointOptions(patch=4, distilled_views=0, motion=MotionOptions(pool=2, length=2)),
        engine=TorchEngine(),
    )
    method.fit(scene, BUDGET, ConsoleLog(folder, quiet=True))
    return method


def test_it_shares_its_training_and_renders_as_it_is_asked_to(
    ball_scene: Scene, tmp_path: Path
) -> None:
    camera = ball_scene.splits["test"].cameras[0]
    taught = {"channels": 4, "steps": 4.0, "stop": 1e-2}
    usual = fitted(SteerNerf, PipelineOptions(**taught), ball_scene, tmp_path)
    want = usual.render(camera, NullProbe()).rgb
    told = {"taught_steps": 4.0, "taught_stop": 1e-2}
    for asked, same in ((taught, True), ({"channels": 4, "steps": 1.0, "stop": 1e-4}, False)):
        options = UntaughtOptions(**asked, **told)
        method = fitted(UntaughtSteerNerf, options, ball_scene, tmp_path)
        assert torch.equal(method.render(camera, NullProbe()).rgb, want) == same
    assert len(list((tmp_path / "stages").glob("steernerf-*"))) == 1


def test_what_is_taught_is_checked_too() -> None:
    with pytest.raises(ValueError, match=r"stop: expected a transmittance .* got 1\.5"):
        UntaughtOptions(taught_stop=1.5)

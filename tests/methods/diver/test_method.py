"""DIVeR as a method: what it learns, what a training leaves, what it refuses."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from bench.metrics import psnr
from bench.types import EMPTY_ALPHA, Budget, Log, NullProbe, Scene
from methods.diver.method import Diver
from methods.diver.training import DiverTraining, Lessons
from methods.instant_ngp.stage1 import Setup, TrainedField, train_field
from methods.instant_ngp.training import TrainingOptions
from methods.kernels.encode import HashGrid
from methods.training import loop

GRID = HashGrid(levels=8, log2_table=12, n_min=8, n_max=64)
SETUP = Setup.resolved(GRID, TrainingOptions(), "bf16", "auto", "cpu", seed=0)
LESSONS = Lessons(prune_rays=1 << 13)
BUDGET = Budget("test", steps=150, samples=8192, renderer_steps=60)


def fitted(scene: Scene, log: Log, budget: Budget = BUDGET, **options) -> Diver:
    settings = {"resolution": 128, "training": LESSONS} | options
    method = Diver(teacher=SETUP, **settings)
    method.fit(scene, budget, log)
    return method


def quality(method: Diver, scene: Scene) -> float:
    test = scene.splits["test"]
    truth = test.images[1].float() / 255
    on_white = truth[..., :3] * truth[..., 3:] + 1 - truth[..., 3:]
    return psnr(method.render(test.cameras[1], NullProbe()).rgb, on_white)


def test_it_learns_a_ball(ball_scene: Scene, quiet_log: Log) -> None:
    budget = Budget("test", steps=150, samples=8192, renderer_steps=200)
    method = fitted(ball_scene, quiet_log, budget)
    print(quality(method, ball_scene), method.sizes(), len(method.baked.model.voxels))
    assert quality(method, ball_scene) > 24

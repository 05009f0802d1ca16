"""The lean method as the harness uses it."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import pytest
import torch

from bench.types import Budget, Log, NullProbe, Scene
from methods.engines.torch_engine import TorchEngine
from methods.steernerf.options import Skips
from methods.steernerf.views import Views
from methods.steernerf_lean.lean_renderer import LeanRenderer
from methods.steernerf_lean.method import SteerNerfLean
from tests.methods.models import lean_joint, lean_model, lean_pipeline, lean_rendering, small_motion
from tests.methods.trainings import GRID, QUICK

BUDGET = Budget("test", steps=40, samples=1024, renderer_steps=4)


def new_method(frames: int = 1, **rendering: Any) -> SteerNerfLean:
    motion = small_motion(pool=2, length=2)
    return SteerNerfLean(
        grid=GRID,
        training=QUICK,
        model=lean_model(channels=5, frames=frames, step=4.0),
        rendering=lean_rendering(**{"step": 4.0} | rendering),
        renderer=partial(LeanRenderer, width=8, blocks=1, init="scratch"),
        joint=lean_joint(patch=4, distilled_views=2, motion=motion),
        engine=TorchEngine(),
        device="cpu",
    )


@pytest.mark.parametrize("frames", [0, 1])
def test_a_rendering_may_be_exchanged_between_frames(
    ball_scene: Scene, shared_log: Log, frames: int
) -> None:
    method = new_method(frames, refined=1.0)
    method.fit(ball_scene, BUDGET, shared_log)
    assert method.pipeline.renderer.layout.history == (frames > 0)
    camera = ball_scene.splits["test"].cameras[0]
    refined = method.render(camera, NullProbe()).rgb
    method.reset()
    method.rendering = replace(method.rendering, refined=0.0)
    drawn = method.render(camera, NullProbe()).rgb
    assert not torch.equal(drawn, refined)


def test_a_training_depends_on_its_options_and_on_nothing_that_is_chosen_afterwards() -> None:
    usual, skip = new_method().stage2, Skips(empty=True, hidden=True, background=False)
    other = new_method(overlap=0.5, refined=0.25, refined_step=2.0, skip=skip).stage2
    assert other.key(BUDGET) == usual.key(BUDGET)
    as_trained = lean_rendering(step=4.0, refined=0.2, refined_step=2.0)
    assert other.joint.rendering(other.model) == as_trained
    joint = replace(usual.joint, average=0.5)
    assert replace(usual, joint=joint).key(BUDGET) != usual.key(BUDGET)


def test_of_a_frame_for_the_engine_only_its_own_inputs_are_recorded(
    ball_scene: Scene, quiet_log: Log
) -> None:
    """Not those of the frames before it, whose pictures are drawn as well."""
    pipeline = lean_pipeline()
    frames = Views(pipeline, ball_scene, new_method().stage2.joint, 0, quiet_log).inputs(3)
    assert [rows.shape[1] for rows, _ in frames] == 3 * [pipeline.renderer.layout.width]

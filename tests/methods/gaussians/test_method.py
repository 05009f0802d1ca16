"""3D Gaussians as a method: what they learn, what a training leaves, what is measured of others."""

from dataclasses import replace

import pytest
import torch

from bench.types import Budget, Log, NullProbe, Scene
from methods.gaussians.method import GaussianSplatting
from tests.common import assert_near
from tests.methods.trainings import GRID, PIXEL, QUICK, TAUGHT, quality, shows_the_ball
from tests.methods.usual import new_gaussians


def fitted(scene: Scene, log: Log, budget: Budget = TAUGHT, **options) -> GaussianSplatting:
    method = new_gaussians(**{"grid": GRID, "training": QUICK, "count": 400} | options)
    method.fit(scene, budget, log)
    return method


@pytest.mark.slow
def test_they_learn_a_ball(ball_scene, shared_log):
    method = fitted(ball_scene, shared_log, replace(TAUGHT, renderer_steps=300))
    # Depth is that of the centres of Gaussians, which reach out of the ball.
    shows_the_ball(method, ball_scene, 24, 4 * PIXEL)


def test_a_training_is_found_again_and_left_for_others(ball_scene, quiet_log, tmp_path):
    budget = Budget("test", steps=40, samples=1024, renderer_steps=20)
    first = fitted(ball_scene, quiet_log, budget)
    again = fitted(ball_scene, quiet_log, budget)
    assert again.train_s == first.train_s > 0
    assert again.train_peak_bytes == first.train_peak_bytes > 0
    (exported,) = (tmp_path / "outputs").rglob("gaussians.ply")
    shown = fitted(ball_scene, quiet_log, budget, checkpoint=str(exported))
    camera = ball_scene.splits["test"].cameras[0]
    pictures = [m.render(camera, NullProbe()).rgb for m in (first, again, shown)]
    assert torch.equal(pictures[0], pictures[1])
    assert_near(pictures[2], pictures[0], atol=1e-4)
    assert shown.train_s == 0


def test_sizes_are_those_of_what_is_stored(ball_scene, shared_log):
    plain = fitted(ball_scene, shared_log)
    small = fitted(ball_scene, shared_log, stored="int8", stop=0.5)
    assert small.train_s == plain.train_s  # both are chosen after a training
    small = fitted(ball_scene, shared_log, stored="int8")
    assert plain.sizes() == {"gaussians": 400 * 59 * 4}
    assert small.sizes()["gaussians"] < plain.sizes()["gaussians"] / 3.5
    assert abs(quality(small, ball_scene) - quality(plain, ball_scene)) < 0.5

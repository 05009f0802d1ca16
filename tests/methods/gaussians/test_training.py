"""Where Gaussians start; relocation and noise: what stays the same when one becomes many."""

import math
from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from bench.types import Scene
from methods.gaussians import training
from methods.gaussians.model import Gaussians
from methods.gaussians.training import (
    DEAD,
    GaussianTraining,
    anywhere,
    disturb,
    on_surfaces,
    relocate,
    shared_between,
    spacing,
)
from methods.kernels.types import Pixels
from tests.common import seeded
from tests.methods.trainings import TEACHER, does_not_see_what_masks_hide, goes_on_after_a_kill
from tests.methods.usual import usual


def test_they_begin_on_surfaces_with_their_colours(ball_scene, teacher):
    points, colours = on_surfaces(teacher, ball_scene, 500, seeded(0))
    radius = (points - 0.5).norm(dim=1)
    assert len(points) == 500
    assert abs(radius.median().item() - 0.3) < 2 * 1.6 / 40
    error = colours - (0.5 + (points - 0.5) / 0.6).clamp(0, 1)  # the ball is coloured by its normal
    assert error.abs().median() < 0.1  # two colours drawn at random are 0.3 apart


def test_points_come_from_all_pictures_alike(ball_scene, monkeypatch):
    """Three of five pixels show matter, at their camera."""

    def render(field, rays, *_):
        alpha = torch.arange(len(rays.origins)) % 5 < 3
        return replace(Pixels.blank(len(alpha), 3), alpha=alpha.float())

    monkeypatch.setattr(training, "render_rays", render)
    field = SimpleNamespace(device=torch.device("cpu"))
    trained = SimpleNamespace(field=field, occupancy=None, sampling=None)
    cameras, each = ball_scene.splits["train"].cameras, 30
    points, _ = on_surfaces(trained, ball_scene, each * len(cameras), seeded(0))
    found = [int((points == camera.c2w[:, 3]).all(dim=1).sum()) for camera in cameras]
    # Two draws of 18 points a picture, of which five in six are taken; each can be off by 2.
    assert found == pytest.approx([each] * len(cameras), abs=4)


def test_spacing_is_the_distance_of_neighbours(ball_scene):
    lattice = torch.cartesian_prod(*[0.1 * torch.arange(4.0)] * 3)
    torch.testing.assert_close(spacing(lattice), torch.full((64,), 0.1))
    assert (spacing(torch.zeros(10, 3)) > 0).all()  # all in one place
    points, _ = anywhere(ball_scene, 100, seeded(0))
    assert ((points >= 0.1) & (points <= 0.9)).all()


def new_training(scene: Scene, steps: int = 40, **options: Any) -> GaussianTraining:
    points, colours = anywhere(scene, 200, seeded(0))
    gaussians = Gaussians.at(points, colours, 0.5 * spacing(points), 0.5, degree=3)
    fitting = usual("method/gaussians", "fitting", **{"every": 10, **options})
    return GaussianTraining(gaussians, scene, steps, fitting, TEACHER)


def test_a_killed_training_goes_on_as_if_it_had_not_been(ball_scene, tmp_path):
    goes_on_after_a_kill(partial(new_training, ball_scene), 23, tmp_path)


def test_masked_pixels_are_not_learnt_from_in_either_size(ball_scene):
    does_not_see_what_masks_hide(partial(new_training, steps=8, half=0.5), ball_scene)


def some(opacities: list[float]) -> tuple[Gaussians, torch.optim.Adam]:
    """Gaussians in a row along x, two units apart; and Adam after a step in which everything had a
    gradient of 1, at no rate."""
    count = len(opacities)
    points = 2 * torch.arange(count)[:, None] * torch.tensor([1.0, 0.0, 0.0])
    gaussians = Gaussians.at(points, torch.rand(count, 3), torch.full((count,), 0.1), 0.5, degree=1)
    gaussians.logits.data = torch.tensor(opacities).logit()
    optimiser = torch.optim.Adam(gaussians.parameters(), lr=0.0)
    for parameter in gaussians.parameters():
        parameter.grad = torch.ones_like(parameter)
    optimiser.step()
    return gaussians, optimiser


@pytest.mark.parametrize("copies", [1, 2, 3, 7])
@pytest.mark.parametrize("opacity", [0.05, 0.6, 0.99])
def test_copies_are_together_as_opaque_as_the_one_they_replace(opacity, copies):
    new, shrink = shared_between(torch.tensor([opacity]), torch.tensor([copies]))
    assert 1 - (1 - new.item()) ** copies == pytest.approx(opacity, rel=1e-5)
    # Along a line through the centre, by quadrature; sigma is 1 before and `shrink` after.
    x = torch.linspace(-12, 12, 100_001, dtype=torch.float64)
    together = 1 - (1 - new * torch.exp(-((x / shrink) ** 2) / 2)) ** copies
    whole = torch.trapezoid(together, x).item()
    assert whole == pytest.approx(opacity * math.sqrt(2 * math.pi), rel=1e-5)


def test_the_dead_move_to_the_living():
    gaussians, optimiser = some([0.9, DEAD / 2, 0.3, DEAD / 5])
    before = gaussians.means.detach().clone()
    assert relocate(gaussians, optimiser, seeded(0)) == 2
    alive = before[[0, 2]]
    for moved in (1, 3):
        assert (gaussians.means[moved] == alive).all(dim=1).any()
    assert torch.equal(gaussians.means[[0, 2]], alive)
    assert (gaussians.opacities > DEAD).all()


def test_what_moved_and_what_it_moved_to_forget_their_moments():
    gaussians, optimiser = some([0.9, DEAD / 2, 1e-9])  # nothing else to move to
    gaussians.logits.data[2] = gaussians.logits.data[0]
    assert relocate(gaussians, optimiser, seeded(1)) == 1
    moments = optimiser.state[gaussians.means]["exp_avg"]
    source = 0 if torch.equal(gaussians.means[1], gaussians.means[0]) else 2
    assert (moments[[1, source]] == 0).all()
    assert (moments[2 - source] != 0).all()


@pytest.mark.parametrize("opacities", [[0.5, 0.6], [DEAD / 2, DEAD / 3]], ids=["none", "all"])
def test_nothing_moves_if_none_or_all_are_dead(opacities):
    gaussians, optimiser = some(opacities)
    before = [parameter.detach().clone() for parameter in gaussians.parameters()]
    assert relocate(gaussians, optimiser, torch.Generator()) == 0
    assert all(map(torch.equal, gaussians.parameters(), before))


def test_noise_moves_the_faint_along_their_shape_and_leaves_the_opaque():
    gaussians, _ = some([0.9] + [DEAD / 10] * 999)
    before = gaussians.means.detach().clone()
    gaussians.log_scales.data[:] = torch.tensor([0.1, 0.01, 0.001]).log()
    disturb(gaussians, 1.0, seeded(0))
    moved = (gaussians.means - before).detach()
    assert moved[0].abs().max() < 1e-9
    # The variances of the shape are 0.01, 1e-4 and 1e-6, times a faintness of about 0.61.
    spread = moved[1:].std(dim=0)
    want = torch.sigmoid(torch.tensor(100 * (0.005 - DEAD / 10))) * torch.tensor([1e-2, 1e-4, 1e-6])
    # Of 999 normal numbers the standard deviation is known to 1 / sqrt(2 * 999), 2 %: four times.
    torch.testing.assert_close(spread, want, rtol=0.09, atol=1e-7)

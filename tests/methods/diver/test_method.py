"""DIVeR as a method: how it begins, what it prunes, what a training leaves, what it refuses."""

from dataclasses import replace

import pytest
import torch

from methods.students.voxels import corners_of
from tests.common import refusal
from tests.methods.small_students import SMALL, fitted
from tests.methods.trainings import GRID, TAUGHT, TEACHER, quality

new = SMALL["diver"]


def test_it_begins_with_the_encoding_of_the_teacher(ball_scene, teacher):
    model = new().begin(teacher, ball_scene, TAUGHT).model
    cells = model.voxels.coordinates.long() * 4  # the teacher's grid is four times as fine
    near = teacher.occupancy.cells.unfold(0, 4, 4).unfold(1, 4, 4).unfold(2, 4, 4)
    assert near.flatten(3).any(dim=3).sum() == len(cells) > 0
    assert model.table[:, : GRID.channels].std().item() == pytest.approx(1, rel=1e-4)
    assert (model.table[:, GRID.channels :] == 0).all()


def test_sparsity_draws_a_negative_density_back_to_zero(ball_scene, teacher):
    """Its slope is 4 s / (1 + 2 s^2) of the mean, of the first `count` densities alone."""
    training = new().begin(teacher, ball_scene, TAUGHT)
    raw = torch.tensor([-2.0, 0.0, 0.5, 3.0], requires_grad=True)
    training._push_to_sparsity(raw, 3)
    raw.relu().mul(0).sum().backward()
    wanted = training.options.sparsity / 3 * torch.tensor([-8 / 9, 0, 4 / 3, 0])
    torch.testing.assert_close(raw.grad, wanted)


def test_pruning_leaves_what_shows(ball_scene, teacher):
    late = replace(new().training, prune_at=1.0)
    method = new(stored="fp32", stop=1e-4, faint=0.0, training=late)
    method.background = ball_scene.background
    training = method.begin(teacher, ball_scene, replace(TAUGHT, renderer_steps=200))
    while training.step < 100:
        training.advance()
    method.restore(training.result())
    before, voxels = quality(method, ball_scene), len(training.model.voxels)
    training._prune()
    method.restore(training.result())
    assert len(training.model.voxels) < 0.9 * voxels
    # A ray that loses k voxels of weights below 0.01 changes by k / 100 at most; few lose any.
    assert abs(quality(method, ball_scene) - before) < 0.5
    training.advance()  # moments and gradients have the rows that are left


def test_sizes_are_those_of_what_is_stored(ball_scene, shared_log):
    half, single = (
        fitted("diver", ball_scene, shared_log, 40, stored=kind) for kind in ("bf16", "fp32")
    )
    corners = len(corners_of(half.baked.corners.voxels.coordinates)[1])
    merged = 32 * 32 + 32 + 32 + 1 + 32 * 32 + 32 * 27 + 32 + 3 * 32 + 3
    assert half.sizes() == {"corners": corners * 64, "voxels": 32**3 // 8, "decoder": 4 * merged}
    assert single.sizes()["corners"] == 2 * half.sizes()["corners"]
    # Features are rounded to 1/256 of themselves: far less than a picture's error of 1/16.
    assert abs(quality(half, ball_scene) - quality(single, ball_scene)) < 0.1


def test_a_teacher_with_more_features_than_a_corner_is_refused(ball_scene, shared_log):
    setup = replace(TEACHER, grid=replace(GRID, levels=17))
    with refusal("expected at most the 32 channels of a corner", ValueError):
        new(teacher=setup).fit(ball_scene, replace(TAUGHT, steps=1), shared_log)

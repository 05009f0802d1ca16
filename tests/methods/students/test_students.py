"""What the methods that start from a trained field have in common: a training survives a kill and
is found again; they learn a ball; wrong settings are refused."""

from dataclasses import replace

import pytest
import torch

from bench.types import NullProbe
from methods.instant_ngp.stage1 import train_field
from tests.methods.small_students import SMALL, budget, fitted
from tests.methods.trainings import EXACT_TEACHER, PIXEL, goes_on_after_a_kill, shows_the_ball

names = pytest.mark.parametrize("name", SMALL)


@pytest.mark.parametrize(
    ("name", "steps", "killed_at"),
    [
        ("diver", 40, 3),
        ("diver", 40, 25),  # after its voxels were pruned
        ("kilonerf", 12, 8),  # of which six from points
        ("nerf", 4, 3),  # points, then rays
        ("nsvf", 4, 3),
        ("plenoctree", 20, 9),
    ],
)
def test_a_killed_training_goes_on_as_if_it_had_not_been(
    name, steps, killed_at, ball_scene, shared_log, tmp_path
):
    given = budget(name, steps)
    trained = train_field(SMALL[name]().teacher, ball_scene, given, shared_log)

    def training():
        return SMALL[name]().begin(trained, ball_scene, given)

    goes_on_after_a_kill(training, killed_at, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "steps", "least", "off"),
    [
        ("diver", 200, 24, 2 / 32),  # voxels
        ("kilonerf", 40, 20, 4 * PIXEL),
        ("nerf", 60, 16, 1.0),
        ("nsvf", 60, 16, 1.0),
    ],
)
def test_it_learns_a_ball(name, steps, least, off, ball_scene, shared_log):
    shows_the_ball(fitted(name, ball_scene, shared_log, steps), ball_scene, least, off)


@names
def test_a_training_is_found_again(name, ball_scene, shared_log):
    first = fitted(name, ball_scene, shared_log)
    again = fitted(name, ball_scene, shared_log)
    other = fitted(name, ball_scene, shared_log, stop=0.5)  # is chosen after a training
    assert first.train_s == again.train_s == other.train_s > 0
    assert first.train_peak_bytes == again.train_peak_bytes > 0
    camera = ball_scene.splits["test"].cameras[0]
    pictures = [method.render(camera, NullProbe()).rgb for method in (first, again)]
    assert torch.equal(*pictures)


@names
def test_a_row_names_what_its_own_products_are_computed_in(name):
    """`stored` is another matter: it is what they are computed from."""
    teacher = replace(EXACT_TEACHER, precision="bf16")
    as_teacher = name in ("nerf", "nsvf")
    shown = SMALL[name](teacher=teacher).settings()
    computed = teacher.settings(object)["field_precision"] if as_teacher else "fp32"
    assert (shown["engine"], shown["precision"]) == ("none", "none")
    assert shown["field_precision"] == computed

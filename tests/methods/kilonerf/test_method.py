"""KiloNeRF as a method: what it learns, what a training leaves."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from bench.types import Budget, Log, NullProbe, Scene
from methods.instant_ngp.stage1 import TrainedField
from methods.kilonerf.field import SHAPES
from methods.kilonerf.method import KiloNerf
from methods.kilonerf.training import KiloLessons
from methods.training import loop
from tests.methods.trainings import TAUGHT, TEACHER, goes_on_after_a_kill, quality

LESSONS = KiloLessons(points_each=64, rate=1e-2)


def method(**options) -> KiloNerf:
    return KiloNerf(**{"teacher": TEACHER, "training": LESSONS, "networks": 4} | options)


def fitted(scene: Scene, log: Log, **options) -> KiloNerf:
    student = method(**options)
    student.fit(scene, TAUGHT, log)
    return student


@pytest.mark.slow
def test_it_learns_a_ball(ball_scene: Scene, shared_log: Log) -> None:
    student = fitted(ball_scene, shared_log)
    test = ball_scene.splits["test"]
    frame = student.render(test.cameras[1], NullProbe())
    assert quality(student, ball_scene) > 20
    assert abs(frame.depth[16, 16].item() - 1.3) < 4 * 1.6 / 40  # the front, to four pixels


def test_a_killed_training_goes_on_as_if_it_had_not_been(
    ball_scene: Scene, teacher: TrainedField, tmp_path: Path
) -> None:
    budget = Budget("test", steps=100, samples=2048, renderer_steps=12)

    def training() -> loop.Training:
        return method().begin(teacher, ball_scene, budget)

    goes_on_after_a_kill(training, 8, tmp_path)  # of which six from points


def test_a_finished_training_is_found_again(ball_scene: Scene, shared_log: Log) -> None:
    first, again = (fitted(ball_scene, shared_log) for _ in range(2))
    assert again.train_s == first.train_s > 0
    camera = ball_scene.splits["test"].cameras[0]
    pictures = [student.render(camera, NullProbe()).rgb for student in (first, again)]
    assert torch.equal(*pictures)


def test_sizes_are_those_of_the_networks(ball_scene: Scene, shared_log: Log) -> None:
    student = fitted(ball_scene, shared_log)
    parameters = sum(i * o + o for i, o in SHAPES.values())
    assert parameters == 6212  # of the publication
    cubes = student.grid.networks
    assert student.sizes() == {
        "networks": student.grid.count * parameters * 4,
        "network_grid": cubes.numel() * 2,
        "occupancy": 128**3 // 8,
    }


@pytest.mark.parametrize(
    "wrong", [{"networks": 0}, {"networks": 33}, {"stop": 1.0}], ids=lambda wrong: str(wrong)
)
def test_wrong_settings_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="expected"):
        method(**wrong)


@pytest.mark.parametrize("wrong", [{"points_each": 0}, {"view_cost": -1.0}, {"points": 2.0}])
def test_wrong_lessons_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="expected"):
        KiloLessons(**wrong)

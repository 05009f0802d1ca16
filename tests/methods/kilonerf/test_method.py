"""KiloNeRF as a method: what it learns, what a training leaves."""

from __future__ import annotations

import pytest

from bench.types import Log, NullProbe, Scene
from methods.kilonerf.kernels.grouped_mlp import SHAPES
from methods.kilonerf.method import KiloLessons, KiloNerf
from tests.methods.trainings import TAUGHT, TEACHER, quality


def fitted(scene: Scene, log: Log) -> KiloNerf:
    lessons = KiloLessons(points_each=64, rate=1e-2)
    student = KiloNerf(teacher=TEACHER, training=lessons, networks=4)
    student.fit(scene, TAUGHT, log)
    return student


@pytest.mark.slow
def test_it_learns_a_ball(ball_scene: Scene, shared_log: Log) -> None:
    student = fitted(ball_scene, shared_log)
    frame = student.render(ball_scene.splits["test"].cameras[1], NullProbe())
    assert quality(student, ball_scene) > 20
    assert abs(frame.depth[16, 16].item() - 1.3) < 4 * 1.6 / 40  # the front, to four pixels


def test_sizes_are_those_of_the_networks(ball_scene: Scene, shared_log: Log) -> None:
    student = fitted(ball_scene, shared_log)
    parameters = sum(i * o + o for i, o in SHAPES.values())
    assert parameters == 6212  # of the publication
    assert student.sizes() == {
        "networks": student.grid.count * parameters * 4,
        "network_grid": student.grid.networks.numel() * 2,
        "occupancy": 128**3 // 8,
    }

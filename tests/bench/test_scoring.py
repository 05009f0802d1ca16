"""Scores come one frame at a time; flicker only where two consecutive frames have a truth."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from bench.metrics import flicker, quantise
from bench.protocol import EvaluationProtocol, Scoring
from bench.trajectories import Step, Trajectory, from_split
from bench.types import composite

QUICK = EvaluationProtocol(name="quick", lpips=())
WHITE = torch.ones(3)


def scores(scene, trajectory: Trajectory, protocol=QUICK, levels=None) -> list[dict]:
    """Of frames of one grey level each: darker from one to the next, unless said otherwise."""
    scoring = Scoring(scene, trajectory, protocol, {})
    return [
        scoring.score(index, step, torch.full((step.camera.height, step.camera.width, 3), level))
        for index, (step, level) in enumerate(
            zip(trajectory.steps, levels or [0.9, 0.7, 0.5, 0.3, 0.2, 0.1], strict=True)
        )
    ]


def known(found: list[dict]) -> list[int]:
    return [index for index, figures in enumerate(found) if "flicker" in figures]


def test_flicker_is_that_of_the_rounded_prediction_and_the_frame_before(tiny_scene):
    found = scores(tiny_scene, from_split(tiny_scene))
    assert known(found) == [1, 2, 3, 4, 5]
    first, second = (composite(image, WHITE) for image in tiny_scene.splits["test"].images[:2])
    light, dark = (quantise(torch.full((32, 40, 3), level)) for level in (0.9, 0.7))
    assert found[1]["flicker"] == pytest.approx(flicker(dark, second, light, first), rel=1e-9)


def test_a_cut_or_a_frame_without_truth_leaves_no_pair(tiny_scene):
    steps = list(from_split(tiny_scene).steps)
    steps[2] = replace(steps[2], cut=True)
    steps[4] = replace(steps[4], truth=None)
    found = scores(tiny_scene, Trajectory("some", "test", tuple(steps)))
    assert known(found) == [1, 3]
    assert found[4] == {}
    assert "psnr" in found[5]


def test_pictures_of_different_size_are_no_pair(tiny_scene):
    cameras = tiny_scene.splits["test"].cameras
    images = tiny_scene.splits["test"].images
    small = replace(cameras[1], width=20)
    split = replace(
        tiny_scene.splits["test"],
        cameras=[cameras[0], small, cameras[2]],
        images=[images[0], images[1][:, :20], images[2]],
    )
    mixed = replace(tiny_scene, splits={"test": split})
    steps = tuple(Step(camera, index) for index, camera in enumerate(split.cameras))
    assert known(scores(mixed, Trajectory("mixed", "test", steps), levels=[0.1, 0.2, 0.3])) == []


def test_the_exact_picture_of_a_scene_serves_flicker_when_the_protocol_asks(tiny_scene):
    asked = []

    def exact(camera):
        asked.append(camera)
        return torch.full((camera.height, camera.width, 4), 255, dtype=torch.uint8)

    scene = replace(tiny_scene, exact=exact)
    steps = tuple(replace(step, truth=None) for step in from_split(tiny_scene).steps)
    unscored = Trajectory("unscored", "test", steps)
    protocol = replace(QUICK, flicker="exact")
    found = scores(scene, unscored, protocol)
    assert [set(figures) for figures in found] == [set(), *[{"flicker"}] * 5]
    assert found[1]["flicker"] == pytest.approx(0.2, abs=1 / 255)
    assert len(asked) == 6
    assert known(scores(scene, unscored)) == []  # "split"
    assert known(scores(tiny_scene, unscored, protocol)) == []  # a scene that does not know
    scores(scene, from_split(scene), protocol)
    assert len(asked) == 6  # ground truth is there


@pytest.mark.parametrize(("pictures", "kept"), [(0, []), (2, [0, 5]), (99, [0, 1, 2, 3, 4, 5])])
def test_as_many_pictures_are_kept_as_asked_for(tiny_scene, pictures: int, kept: list[int]) -> None:
    trajectory = from_split(tiny_scene)
    scoring = Scoring(tiny_scene, trajectory, QUICK, {}, pictures)
    for index, step in enumerate(trajectory.steps):
        scoring.score(index, step, composite(tiny_scene.splits["test"].images[index], WHITE))
    kinds = ("truth", "rendered", "error")
    assert list(scoring.images) == [f"{index:04d}-{kind}" for index in kept for kind in kinds]

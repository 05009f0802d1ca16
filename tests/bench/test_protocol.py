"""A protocol is what its name says, and scores as it says, one frame at a time."""

from __future__ import annotations

import hashlib
import math
from dataclasses import replace
from pathlib import Path

import hydra
import pytest
import torch
from omegaconf import OmegaConf

from bench.cameras import scale_camera
from bench.metrics import flicker, psnr, quantise
from bench.protocol import EvaluationProtocol, Scoring
from bench.trajectories import Step, Trajectory, from_split
from bench.types import SteerbenchError, composite

CONFIGS = Path(__file__).parents[2] / "sweeps" / "configs" / "protocol"
WHITE = torch.ones(3)
QUICK = EvaluationProtocol(name="quick", lpips=())


def test_the_configuration_of_steerbench_1_is_the_default():
    config = OmegaConf.load(CONFIGS / "steerbench-1.yaml")
    assert hydra.utils.instantiate(config) == EvaluationProtocol()


def test_a_changed_protocol_may_not_keep_the_name():
    with pytest.raises(SteerbenchError, match=r"protocol\.ssim differs from what steerbench-1"):
        EvaluationProtocol(ssim="uniform")
    assert EvaluationProtocol(name="nsvf", ssim="uniform").ssim == "uniform"


CHOICES = {"rounding": "floor", "ssim": "ms", "background": "grey", "memory": "warm"}


@pytest.mark.parametrize(("option", "value"), [*CHOICES.items(), ("flicker", "no"), ("warmup", -1)])
def test_an_unknown_choice_names_the_option_and_what_is_allowed(option, value):
    with pytest.raises(SteerbenchError, match=f"protocol.{option}: expected .* got '?{value}"):
        EvaluationProtocol(**{"name": "mine", option: value})


def test_a_picture_is_composited_with_its_straight_alpha(device):
    picture = torch.tensor([[[255, 0, 51, 0], [255, 0, 51, 255], [255, 0, 51, 102]]]).byte()
    background = torch.tensor([1.0, 0.5, 0.0], device=device)
    expected = [[1.0, 0.5, 0.0], [1.0, 0.0, 0.2], [1.0, 0.3, 0.08]]
    got = composite(picture.to(device), background)[0].cpu()
    torch.testing.assert_close(got, torch.tensor(expected), atol=1e-7, rtol=0)
    rgb = composite(picture[..., :3].to(device), background)[0].cpu()
    torch.testing.assert_close(rgb, torch.tensor([[1.0, 0.0, 0.2]] * 3), atol=1e-7, rtol=0)


def test_the_prediction_is_clipped_and_rounded_and_the_ground_truth_is_not(device):
    reference = torch.randint(256, (16, 16, 4), dtype=torch.uint8)
    truth = composite(reference, WHITE)
    prediction = truth + 0.3 * torch.randn(16, 16, 3)
    scores = QUICK.score(prediction.to(device), reference, WHITE, {})
    assert scores["psnr"] == pytest.approx(psnr(quantise(prediction), truth), rel=1e-9)
    raw = replace(QUICK, rounding="none").score(prediction.to(device), reference, WHITE, {})
    assert raw["psnr"] == pytest.approx(psnr(prediction, truth), rel=1e-9)
    assert raw["psnr"] != scores["psnr"]


def test_every_metric_is_scored_and_a_missing_backbone_is_nan():
    protocol = EvaluationProtocol()
    picture = torch.zeros(12, 12, 3, dtype=torch.uint8)
    halves = {"vgg": lambda image, reference: 0.5}
    scores = protocol.score(torch.zeros(12, 12, 3), picture, WHITE, halves)
    assert tuple(scores) == protocol.metric_names == ("psnr", "ssim", "lpips_alex", "lpips_vgg")
    assert math.isnan(scores["lpips_alex"])
    assert scores["lpips_vgg"] == 0.5


def test_backbones_that_cannot_be_had_are_named_with_the_reason_once_in_a_process(
    monkeypatch, tmp_path, log, lpips_weights
):
    monkeypatch.setattr("bench.protocol._named", set())
    monkeypatch.setattr("bench.published._unreachable", ["no network"])
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    monkeypatch.delenv("STEERBENCH_WEIGHTS", raising=False)
    (tmp_path / "alexnet_features.pth").symlink_to(lpips_weights / "alexnet_features.pth")
    weights = (tmp_path / "alexnet_features.pth").read_bytes()
    found = EvaluationProtocol().find_lpips(tmp_path, log)
    assert found == {"alex": hashlib.sha256(weights).hexdigest(), "vgg": None}
    for _ in range(2):
        loaded, missing = EvaluationProtocol().load_lpips(tmp_path, log)
        assert (list(loaded), list(missing)) == (["alex"], ["lpips_vgg"])
        assert "no network" in missing["lpips_vgg"]
    assert [message.split(":")[0] for message in log.messages] == ["lpips_vgg"]


def test_what_cannot_be_scored_is_refused(tiny_scene):
    trajectory = from_split(tiny_scene)
    QUICK.check(tiny_scene, trajectory)
    black = replace(tiny_scene, background=torch.zeros(3))
    with pytest.raises(SteerbenchError, match=r"scores on white, but scene tiny .* \[0, 0, 0\]"):
        QUICK.check(black, trajectory)
    small = replace(trajectory.steps[0], camera=scale_camera(trajectory.steps[0].camera, 20, 16))
    shrunk = replace(trajectory, steps=(*trajectory.steps, small))
    QUICK.check(tiny_scene, shrunk)
    with pytest.raises(SteerbenchError, match=r"lpips_alex needs .* 31 x 31 pixels, got 20 x 16"):
        EvaluationProtocol().check(tiny_scene, shrunk)
    exact = replace(QUICK, name="exact", flicker="exact")
    with pytest.raises(SteerbenchError, match=r"protocol\.flicker=exact: scene .* has no exact"):
        exact.check(tiny_scene, trajectory)
    exact.check(replace(tiny_scene, exact=lambda camera: torch.zeros(0)), trajectory)


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

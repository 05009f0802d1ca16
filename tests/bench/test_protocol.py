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
from bench.trajectories import from_split
from bench.types import SteerbenchError, composite

CONFIGS = Path(__file__).parents[2] / "sweeps" / "configs" / "protocol"
WHITE = torch.ones(3)
QUICK = EvaluationProtocol(name="quick", lpips=())


def test_the_configuration_of_steerbench_1_is_the_default_and_a_change_may_not_keep_its_name():
    config = OmegaConf.load(CONFIGS / "steerbench-1.yaml")
    assert hydra.utils.instantiate(config) == EvaluationProtocol()
    with pytest.raises(SteerbenchError, match=r"protocol\.ssim differs from what steerbench-1"):
        EvaluationProtocol(ssim="uniform")
    assert EvaluationProtocol(name="nsvf", ssim="uniform").ssim == "uniform"


CHOICES = {"rounding": "floor", "ssim": "ms", "background": "grey", "memory": "warm"}


@pytest.mark.parametrize(
    ("option", "value"), [*CHOICES.items(), ("flicker", "no"), ("warmup", -1), ("lpips_every", 0)]
)
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


def test_backbones_that_cannot_be_had_are_named_once(monkeypatch, tmp_path, log, lpips_weights):
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


def scored(images, cut: int | None = None, **options) -> list[dict]:
    """Of frames of one grey level each, darker from one to the next; None: without a truth."""
    scoring, found = Scoring(QUICK, {}, WHITE, ()), []
    for index, image in enumerate(images):
        height, width = (32, 40) if image is None else image.shape[:2]
        rgb = torch.full((height, width, 3), (0.9, 0.7, 0.5, 0.3, 0.2, 0.1)[index])
        found.append(scoring.score(index, rgb, image, cut=index == cut, **options))
    return found


def test_flicker_is_that_of_the_rounded_prediction_and_the_frame_before(tiny_scene):
    images = tiny_scene.splits["test"].images
    found = scored(images)
    assert ["flicker" in figures for figures in found] == [False, *[True] * 5]
    first, second = (composite(image, WHITE) for image in images[:2])
    light, dark = (quantise(torch.full((32, 40, 3), level)) for level in (0.9, 0.7))
    assert found[1]["flicker"] == pytest.approx(flicker(dark, second, light, first), rel=1e-9)
    alone = scored(images, scored=False)
    assert [set(figures) for figures in alone] == [set(), *[{"flicker"}] * 5]


def test_a_cut_a_frame_without_truth_or_of_another_size_leaves_no_pair(tiny_scene):
    images = list(tiny_scene.splits["test"].images)
    found = scored([*images[:4], None, images[5]], cut=2)
    assert [i for i, figures in enumerate(found) if "flicker" in figures] == [1, 3]
    assert found[4] == {}
    assert "psnr" in found[5]
    found = scored([images[0], images[1][:, :20], images[2]])
    assert not any("flicker" in figures for figures in found)


def test_the_last_of_so_many_frames_is_scored_with_lpips_and_too_few_frames_say_so():
    protocol = EvaluationProtocol(name="some", lpips=("alex",), lpips_every=2)
    scoring = Scoring(protocol, {"alex": lambda *_: 0.5}, WHITE, shown=())
    picture = torch.zeros(16, 16, 3)
    found, said = [], []
    for index in range(8):  # each second one has no truth
        scored = index % 2 == 0
        scores = scoring.score(index, picture, picture.byte(), scored=scored, cut=False)
        found += [scores["lpips_alex"]] if scored else []
        said.append(scoring.missing([]).get("lpips_alex"))
    assert found == [pytest.approx(value, nan_ok=True) for value in (math.nan, 0.5, math.nan, 0.5)]
    few = "protocol.lpips_every is 2, and the path has 1 frames to score"
    assert said == [few, few, *[None] * 6]

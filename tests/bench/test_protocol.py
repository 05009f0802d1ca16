"""A protocol is what its name says, and scores as it says, one frame at a time."""

import hashlib
import math
from dataclasses import replace

import pytest
import torch

from bench.cameras import scale_camera
from bench.metrics import psnr, quantise
from bench.scoring import Scoring
from bench.trajectories import from_split
from bench.types import composite
from tests.common import assert_near, refusal
from tests.conftest import QUICK, STEERBENCH_1


@pytest.mark.parametrize(
    ("option", "value"),
    [("background", "grey"), ("flicker", "no"), ("warmup", -1), ("lpips_every", 0)],
)
def test_an_unknown_choice_names_the_option_and_what_is_allowed(option, value):
    with refusal(f"protocol.{option}: expected .* got '?{value}"):
        replace(QUICK, **{option: value})


def test_a_picture_is_composited_with_its_straight_alpha(device):
    picture = torch.tensor([[[255, 0, 51, 0], [255, 0, 51, 255], [255, 0, 51, 102]]]).byte()
    background = torch.tensor([1.0, 0.5, 0.0], device=device)
    expected = [[1.0, 0.5, 0.0], [1.0, 0.0, 0.2], [1.0, 0.3, 0.08]]
    got = composite(picture.to(device), background)[0].cpu()
    assert_near(got, torch.tensor(expected), atol=1e-7)
    rgb = composite(picture[..., :3].to(device), background)[0].cpu()
    assert_near(rgb, torch.tensor([[1.0, 0.0, 0.2]] * 3), atol=1e-7)


def test_backbones_that_cannot_be_had_are_named(tmp_path, log, publisher, lpips_weights):
    (tmp_path / "alexnet_features.pth").symlink_to(lpips_weights / "alexnet_features.pth")
    weights = (tmp_path / "alexnet_features.pth").read_bytes()
    found = STEERBENCH_1.find_lpips(tmp_path, log)
    assert found == {"alex": hashlib.sha256(weights).hexdigest(), "vgg": None}
    loaded, missing = STEERBENCH_1.load_lpips(tmp_path, log)
    assert (list(loaded), list(missing)) == (["alex"], ["lpips_vgg"])
    assert "404" in missing["lpips_vgg"]
    assert [message.split(":")[0] for message in log.messages] == ["lpips_vgg"]


def test_what_cannot_be_scored_is_refused(tiny_scene):
    trajectory = from_split(tiny_scene)
    QUICK.check(tiny_scene, trajectory)
    black = replace(tiny_scene, background=torch.zeros(3))
    with refusal(r"scores on white, but scene tiny .* \[0, 0, 0\]"):
        QUICK.check(black, trajectory)
    small = replace(trajectory.steps[0], camera=scale_camera(trajectory.steps[0].camera, 20, 16))
    shrunk = replace(trajectory, steps=(*trajectory.steps, small))
    QUICK.check(tiny_scene, shrunk)
    with refusal(r"lpips_alex needs .* 31 x 31 pixels, got 20 x 16"):
        STEERBENCH_1.check(tiny_scene, shrunk)
    exact = replace(QUICK, name="exact", flicker="exact")
    with refusal(r"protocol\.flicker=exact: scene .* has no exact"):
        exact.check(tiny_scene, trajectory)
    exact.check(replace(tiny_scene, exact=lambda camera: torch.zeros(0)), trajectory)


def test_masked_pixels_are_not_scored_unless_the_protocol_says_so(device):
    truth = torch.rand(16, 16, 3).mul(255).byte().to(device)
    mask = torch.arange(16)[:, None].expand(16, 16) < 12
    wrong = composite(truth, torch.ones(3)) + 0.2 * (~mask[..., None]).to(device)
    near = quantise(wrong + 8 / 255 * (torch.arange(16, device=device)[:, None, None] < 6))

    def scored(rgb, mask, use="scene"):
        protocol = replace(QUICK, name="mine", mask=use, colour_correction="affine")
        return Scoring(protocol, {}, torch.ones(3), ()).score(0, rgb, truth, cut=True, mask=mask)

    right = scored(wrong, mask)
    assert (right["psnr"], right["ssim"], right["cc_psnr"]) == (math.inf, 1, math.inf)
    shown = scored(near, mask)
    above = composite(truth, torch.ones(3))[:12]
    assert shown["psnr"] == pytest.approx(psnr(near[:12], above), rel=1e-9)
    filled = torch.cat((near[:12], composite(truth, torch.ones(3))[12:]))
    assert shown["ssim"] == scored(filled, None)["ssim"]
    assert scored(near, mask, "none") == scored(near, None) != shown
    nothing = scored(wrong, torch.zeros_like(mask))
    assert all(math.isnan(score) for score in nothing.values())

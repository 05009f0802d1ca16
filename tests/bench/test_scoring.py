"""Frames are scored one at a time, and against the frame before them."""

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from bench.errors import SteerbenchError
from bench.metrics import flicker, quantise
from bench.scoring import Scoring, taken
from bench.types import Camera, Frame, composite
from tests.common import refusal
from tests.conftest import QUICK

WHITE = torch.ones(3)


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
    protocol = replace(QUICK, name="some", lpips=("alex",), lpips_every=2)
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


# Frames that a method returned


PLAIN = Frame(torch.full((4, 6, 3), 0.5), torch.full((4, 6), math.inf), torch.ones(4, 6))
CAMERA = Camera(torch.eye(4)[:3], 5.0, 5.0, 3.0, 2.0, width=6, height=4)


def test_a_frame_is_taken_as_a_copy():
    given = replace(PLAIN, rgb=PLAIN.rgb.half().requires_grad_())
    found = taken(given, CAMERA, "mine", 7)
    assert torch.equal(found.rgb, given.rgb)
    assert not found.rgb.requires_grad
    parts = zip(*((frame.rgb, frame.depth, frame.alpha) for frame in (found, given)), strict=True)
    assert all(one.data_ptr() != other.data_ptr() for one, other in parts)


@pytest.mark.parametrize(
    ("part", "value", "why"),
    [
        ("rgb", torch.full((4, 6, 3), 128, dtype=torch.uint8), "divide bytes by 255.*uint8"),
        ("rgb", torch.ones(4, 6, 3, dtype=torch.bool), "floating-point numbers.*bool"),
        ("rgb", torch.ones(4, 6, 3, dtype=torch.int64), "floating-point numbers.*int64"),
        ("rgb", torch.ones(4, 6, 3).numpy(), "a torch tensor, got ndarray"),
        ("rgb", torch.ones(6, 4, 3), r"shape \[4, 6, 3\]"),
        ("rgb", torch.full((4, 6, 3), 3.0), "divide 0..255 by 255"),  # a dark one of 0..255
        ("rgb", torch.full((4, 6, 3), 1.2), "numbers from 0 to 1"),
        ("rgb", torch.full((4, 6, 3), -0.01), "numbers from 0 to 1"),
        ("depth", torch.ones(4, 6, 1), r"shape \[4, 6\]"),
        ("depth", torch.full((4, 6), math.nan), "z-depths"),
        ("depth", torch.full((4, 6), -math.inf), "z-depths"),
        ("depth", torch.ones(4, 6, dtype=torch.int32), "floating-point numbers"),
        ("alpha", torch.full((4, 6), math.nan), "from 0 to 1"),
        ("alpha", torch.full((4, 6), 255.0), "from 0 to 1"),
        ("alpha", None, "a torch tensor"),
    ],
)
def test_what_is_no_frame_is_refused_with_the_method_and_the_part(part, value, why):
    with refusal(f"mine: frame 7: {part}: expected .*{why}"):
        taken(replace(PLAIN, **{part: value}), CAMERA, "mine", 7)


def test_a_frame_is_one_of_ours_whose_parts_are_made():
    lazy = SimpleNamespace(rgb=PLAIN.rgb, depth=PLAIN.depth, alpha=PLAIN.alpha)
    with pytest.raises(SteerbenchError, match=r"mine: frame 3: expected a bench.types.Frame"):
        taken(lazy, CAMERA, "mine", 3)


def test_a_picture_of_a_scene_that_is_no_bytes_is_refused():
    with pytest.raises(SteerbenchError, match=r"expected torch.uint8, 0 to 255, got torch.float32"):
        composite(torch.rand(4, 6, 3), torch.ones(3))


def test_a_frame_may_overshoot_a_little():
    """As networks do at edges, and renderers where rounding makes 1.0000001 of an opacity."""
    rgb = torch.full((4, 6, 3), 1.03)
    rgb[0, 0] = -0.5
    frame = Frame(rgb, PLAIN.depth, PLAIN.alpha + 1e-6)
    assert torch.equal(taken(frame, CAMERA, "mine", 0).rgb, rgb)

"""Metrics of a path against closed forms."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from bench.cameras import cast, pixel_grid
from bench.measure import Task, measure, train
from bench.metrics import as_bytes, psnr
from bench.scenes import embedded
from bench.scoring import Scoring
from bench.trajectories import from_split
from bench.types import Budget, Camera, composite
from bench.video_metrics import DepthView, warping_error
from tests.bench.test_metrics import noise
from tests.conftest import QUICK

WHITE = torch.ones(3)


def test_tpsnr_and_tlpips_are_those_of_the_change_from_frame_to_frame():
    """Of LPIPS itself, `test_metrics.py` shows that it is that of the package."""
    pictures = [torch.from_numpy(as_bytes(noise(16, 12, seed))) for seed in range(4)]
    now, true, before, true_before = (picture / 255 for picture in pictures)

    def lpips(one, other):
        return (one - other).square().mean().item()

    protocol = replace(QUICK, name="path", lpips=("alex",), columns=("tlpips", "tpsnr"))
    scoring = Scoring(protocol, {"alex": lpips}, WHITE, ())
    first, second = (
        scoring.score(k, rgb, truth, cut=False)
        for k, (rgb, truth) in enumerate(((before, pictures[3]), (now, pictures[1])))
    )
    assert not {"tlpips_alex", "tpsnr"} & first.keys()
    expected = abs(lpips(before, now) - lpips(true_before, true))
    assert second["tlpips_alex"] == pytest.approx(expected, rel=1e-6)
    assert expected > 0
    expected = psnr(now - before, true - true_before)
    assert second["tpsnr"] == pytest.approx(expected, rel=1e-6)
    again = scoring.score(2, now, pictures[1], cut=False)
    assert (again["flicker"], again["tpsnr"]) == (0, math.inf)


def wall(shift: int, offset: float = 0.0) -> tuple[Tensor, DepthView]:
    """A picture, `offset` brighter, of a painted wall 2 units away, `shift` pixels to the left."""
    pose = torch.eye(4)[:3].clone()
    pose[0, 3] = -shift * 2 / 40
    camera = Camera(pose, 40.0, 40.0, 12.0, 8.0, 24, 16)
    rays = cast(camera, pixel_grid(24, 16))
    x, y, _ = (rays.origins + 2 * rays.directions).T
    rgb = 0.5 + 0.3 * torch.stack((x, y, torch.sin(9 * x)), dim=-1) + offset
    return rgb.view(16, 24, 3), DepthView(camera, torch.full((16, 24), 2.0))


def test_a_still_scene_has_no_warping_error_and_a_blink_that_of_its_square():
    assert warping_error(*wall(0), *wall(3)) == pytest.approx(0, abs=1e-12)
    assert warping_error(*wall(0, 0.1), *wall(3)) == pytest.approx(0.01, rel=1e-5)
    assert warping_error(*wall(0), *wall(3, 0.1)) == pytest.approx(0.01, rel=1e-5)


def test_what_was_hidden_or_is_empty_or_out_of_the_picture_does_not_count():
    (now, view), (then, earlier) = wall(0), wall(3)
    hidden = earlier.depth.clone()
    hidden[4:9, 5:12] = 1.5  # something in front of the wall
    painted = then.clone()
    painted[4:9, 5:12] = 9.0
    assert warping_error(now, view, painted, DepthView(earlier.camera, hidden)) < 1e-12
    empty = view.depth.clone()
    empty[:, :6] = math.inf
    spoilt = now.clone()
    spoilt[:, :6] = 9.0
    assert warping_error(spoilt, DepthView(view.camera, empty), then, earlier) < 1e-12
    assert math.isnan(warping_error(now, view, *wall(24)))


def test_exact_flow_follows_the_true_pictures_of_a_path(tmp_path, quiet_log):
    scene = embedded.load("totem", width=160, train=2, test=8, root=tmp_path, log=quiet_log)
    test = scene.splits["test"]
    (then, earlier), (now, view) = (
        (
            composite(test.images[k], WHITE),
            DepthView(test.cameras[k], scene.surface(test.cameras[k])),
        )
        for k in (0, 7)
    )
    still = (now - then).square()[view.depth < math.inf].mean()
    assert warping_error(now, view, then, earlier) < 0.1 * still


PATH = replace(QUICK, name="path", columns=("tpsnr", "warp"))


def film(protocol, surface=None, cut: int | None = None, depth: bool = True) -> list[dict]:
    """The figures of nine frames of the wall, seen from one place, the truth black."""
    scoring = Scoring(protocol, {}, WHITE, (), surface)
    picture, view = wall(0)
    given = {"camera": view.camera, "depth": view.depth if depth else None}
    truth = torch.zeros(16, 24, 3, dtype=torch.uint8)
    return [scoring.score(k, picture, truth, cut=k == cut, **given) for k in range(9)]


def test_the_metrics_of_a_path_start_when_enough_frames_precede():
    found = film(PATH, cut=1)
    assert [k for k, figures in enumerate(found) if "tpsnr" in figures] == list(range(2, 9))
    assert [k for k, figures in enumerate(found) if "warp_1_own" in figures] == list(range(2, 9))
    assert [k for k, figures in enumerate(found) if "warp_7_own" in figures] == [8]
    assert found[8]["warp_7_own"] == pytest.approx(0, abs=1e-12)


def test_the_flow_is_the_scenes_and_otherwise_named_as_the_methods_own():
    exact = film(PATH, surface=lambda camera: torch.full((16, 24), 2.0), depth=False)
    assert {"warp_1", "warp_7", "warp_1_true", "warp_7_true"} <= exact[8].keys()
    assert exact[8]["warp_7_true"] == 0  # it is all black
    assert "warp_1_own" not in exact[8]
    assert not any(name.startswith("warp") for name in film(PATH, depth=False)[8])


def test_the_flow_works_without_a_truth():
    scoring = Scoring(PATH, {}, WHITE, ())
    picture, view = wall(0)
    truth = torch.zeros(16, 24, 3, dtype=torch.uint8)
    for k in range(10):
        known = None if k in (0, 4, 6) else truth
        figures = scoring.score(k, picture, known, cut=False, camera=view.camera, depth=view.depth)
        assert ("warp_1_own" in figures) == (k > 0)


def test_what_is_missing_says_what_it_needs(tiny_scene, offset_method, quiet_log):
    whole = from_split(tiny_scene)
    steps = (whole.steps[0], replace(whole.steps[1], truth=None), whole.steps[2])
    trajectory = replace(whole, steps=steps)
    task = Task(tiny_scene, trajectory, PATH, Budget("tiny", steps=1, samples=1), seed=0)
    train([offset_method], task, quiet_log)
    (measured,) = measure([offset_method], task, quiet_log)
    missing = measured.record["missing"]
    assert set(missing) == {"tpsnr", "warp_1_own", "warp_7_own"}  # the depths are infinite
    assert missing["tpsnr"] == "needs the true pictures of two consecutive frames"
    assert measured.rows.set_index("metric")["n"][["tpsnr", "warp_7_own"]].tolist() == [0, 0]

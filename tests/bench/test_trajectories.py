"""Trajectories keep the order of their split and thin it out evenly."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import hydra
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from omegaconf import OmegaConf

from bench.cameras import look_at, scale_camera
from bench.trajectories import Step, from_split, smooth, spread, static
from bench.types import Camera, Scene, Split, SteerbenchError

CONFIGS = Path(__file__).parents[2] / "sweeps" / "configs" / "trajectory"


@given(st.integers(1, 500), st.integers(1, 500))
def test_spread_is_even_increasing_and_holds_both_ends(total, count):
    kept = spread(total, count)
    assert len(kept) == min(total, count)
    assert kept[0] == 0
    if len(kept) > 1:
        assert kept[-1] == total - 1
        gaps = [after - before for before, after in pairwise(kept)]
        assert min(gaps) >= 1
        assert max(gaps) - min(gaps) <= 1


def test_nothing_is_spread_into_nothing():
    assert spread(5, 0) == []


def test_a_whole_split_is_rendered_in_its_order_with_its_ground_truth(tiny_scene):
    trajectory = from_split(tiny_scene)
    test = tiny_scene.splits["test"]
    assert [step.camera for step in trajectory.steps] == list(test.cameras)
    assert [step.truth for step in trajectory.steps] == list(range(6))
    assert (trajectory.name, trajectory.split, trajectory.resolution) == ("test", "test", "40x32")


def test_a_limit_stands_in_the_name_unless_it_keeps_everything(tiny_scene):
    thinned = from_split(tiny_scene, limit=3)
    assert [step.truth for step in thinned.steps] == [0, 2, 5]
    assert thinned.name == "test-3of6"
    assert from_split(tiny_scene, limit=99).name == "test"


def test_frames_of_different_size_are_called_mixed(tiny_scene):
    test = tiny_scene.splits["test"]
    cameras = [scale_camera(test.cameras[0], 20, 16), *test.cameras[1:]]
    mixed = replace(tiny_scene, splits={"test": Split(cameras, test.images, test.names)})
    assert from_split(mixed).resolution == "mixed"


def test_a_split_that_is_not_there_or_empty_is_named_with_those_that_are(tiny_scene):
    with pytest.raises(SteerbenchError, match="no frames in 'val'; it has train, test"):
        from_split(tiny_scene, "val")
    empty = replace(tiny_scene, splits={**tiny_scene.splits, "val": Split([], [], [])})
    with pytest.raises(SteerbenchError, match="no frames in 'val'; it has train, test"):
        from_split(empty, "val")


def test_a_negative_limit_is_refused(tiny_scene):
    with pytest.raises(SteerbenchError, match=r"trajectory\.limit"):
        from_split(tiny_scene, limit=-1)


def test_the_configuration_takes_its_limit_from_the_budget(tiny_scene):
    config = OmegaConf.create(
        {"trajectory": OmegaConf.load(CONFIGS / "test.yaml"), "budget": {"frames": 2}}
    )
    trajectory = hydra.utils.instantiate(config.trajectory, tiny_scene)
    assert trajectory == from_split(tiny_scene, limit=2)


def orbit_of(degrees: list[float]) -> Scene:
    """Cameras on a circle of radius 2 around the middle of the unit cube, looking at it."""
    middle, up = torch.full((3,), 0.5), torch.tensor([0.0, 0.0, 1.0])
    cameras = []
    for angle in map(math.radians, degrees):
        eye = middle + 2 * torch.tensor([math.cos(angle), math.sin(angle), 0.0])
        cameras.append(Camera(look_at(eye, middle, up)[:3].float(), 60, 60, 20, 16, 40, 32))
    images = [torch.zeros(32, 40, 4, dtype=torch.uint8)] * len(cameras)
    split = Split(cameras, images, [str(i) for i in range(len(cameras))])
    bounds = torch.tensor([[0.0] * 3, [1.0] * 3])
    return Scene("orbit", {"test": split}, torch.ones(3), bounds, 1.0, "orbit")


def turn_deg(first: Camera, second: Camera) -> float:
    cosine = ((first.c2w[:, :3].T @ second.c2w[:, :3]).trace().item() - 1) / 2
    return math.degrees(math.acos(min(cosine, 1.0)))


def test_a_smooth_path_goes_through_the_cameras_in_even_steps():
    scene = orbit_of([0, 4, 7.5])
    path = smooth(scene)
    cameras = scene.splits["test"].cameras
    assert [step.truth for step in path.steps] == [0, None, None, None, 1, None, None, None, 2]
    assert [s.camera for s in path.steps if s.truth is not None] == list(cameras)
    turns = [turn_deg(a.camera, b.camera) for a, b in pairwise(path.steps)]
    # acos of a float32 cosine near 1 resolves about 0.02 degrees at 1 degree.
    assert turns == pytest.approx([1.0] * 4 + [3.5 / 4] * 4, abs=0.05)
    for step in path.steps:
        distance = (step.camera.c2w[:, 3] - 0.5).norm().item()
        assert 2 * math.cos(math.radians(2)) - 1e-5 <= distance <= 2 + 1e-5


def test_neighbours_that_are_close_enough_stay_neighbours():
    path = smooth(orbit_of([0, 1, 2, 3]))
    assert [step.truth for step in path.steps] == [0, 1, 2, 3]
    assert path.name == "test-smooth1deg"


def test_a_limited_smooth_path_has_no_gaps():
    path = smooth(orbit_of([0, 1, 2, 3]), degrees=0.5, limit=2)
    assert [step.truth for step in path.steps] == [0, None, 1]
    assert path.name == "test-smooth0.5deg-2of4"


def test_a_smooth_path_needs_one_size_and_a_step():
    scene = orbit_of([0, 4])
    with pytest.raises(SteerbenchError, match=r"trajectory\.degrees: expected more than 0, got 0"):
        smooth(scene, degrees=0)
    test = scene.splits["test"]
    cameras = [test.cameras[0], scale_camera(test.cameras[1], 20, 16)]
    mixed = replace(scene, splits={"test": replace(test, cameras=cameras)})
    with pytest.raises(SteerbenchError, match=r"pictures of one size .* 40x32 and 20x16"):
        smooth(mixed)


def test_a_static_path_stays_where_it_is():
    scene = orbit_of([0, 4])
    path = static(scene, view=1, frames=3)
    assert path.steps == (Step(scene.splits["test"].cameras[1], 1),) * 3
    with pytest.raises(SteerbenchError, match=r"trajectory\.view: expected 0 to 1"):
        static(scene, view=2)
    with pytest.raises(SteerbenchError, match=r"trajectory\.frames: expected 1 or more"):
        static(scene, frames=0)

"""Trajectories keep the order of their split and thin it out evenly."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import hydra
import pytest
from hypothesis import given
from hypothesis import strategies as st
from omegaconf import OmegaConf

from bench.cameras import scale_camera
from bench.trajectories import from_split, spread
from bench.types import Split, SteerbenchError

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

"""Embedded scenes: written once and whole, read back as they were rendered."""

import math
import shutil
from pathlib import Path
from unittest.mock import Mock

import pytest
import torch

from bench.scenes import embedded
from bench.scenes.embedded import find, orbit_poses, train_poses
from bench.scenes.embedded.models import MODELS
from bench.types import SteerbenchError
from tests.common import read_json, refusal

SMALL = {"width": 24, "height": 18, "train": 4, "test": 2}


def test_a_scene_is_written_once_in_the_layout_of_nerf_synthetic(tmp_path, log):
    options = {**SMALL, "bounds": "full", "root": tmp_path}
    first = embedded.load("void", **options, log=log)
    written = log.done
    assert written == 2 * 6  # six rendered, six read
    second = embedded.load("void", **options, log=log)
    assert log.done == written + 6
    assert second.digest == first.digest
    (folder,) = tmp_path.iterdir()
    assert folder.name.startswith("void-")
    files = {path.relative_to(folder).as_posix() for path in folder.rglob("*.*")}
    pictures = {f"train/r_{k}.png" for k in range(4)} | {"test/r_0.png", "test/r_1.png"}
    assert files == pictures | {"transforms_train.json", "transforms_test.json"}
    record = read_json(folder / "transforms_train.json")
    assert record["scene"] == {"name": "void", "seed": 0, **SMALL}
    names = {first.name}
    for change in ({"width": 25}, {"height": 19}, {"train": 5}, {"test": 3}, {"seed": 1}):
        names.add(embedded.load("void", **options | change, log=log).name)
    assert len(list(tmp_path.iterdir())) == len(names) == 6
    assert names > {"void-24x18-4train-2test", "void-24x18-4train-2test-seed1"}
    assert embedded._title("void", 400, 400, 60, 24, seed=0) == "void"


def test_who_finishes_second_accepts_the_scene_of_the_first(tmp_path, log, monkeypatch):
    rename = Path.rename

    def overtaken(scene, folder):
        shutil.copytree(scene, folder)
        return rename(scene, folder)

    monkeypatch.setattr(Path, "rename", overtaken)
    embedded.load("void", **SMALL, root=tmp_path, log=log)
    (folder,) = tmp_path.iterdir()
    assert not (folder / "scene").exists()


@pytest.mark.parametrize("name", [*MODELS])
def test_a_scene_knows_its_picture_at_any_camera_as_its_splits_have_it(tmp_path, log, name):
    scene = embedded.load(name, **SMALL, root=tmp_path, log=log)
    assert (scene.surface is None) == (name == "cloud")
    test = scene.splits["test"]
    for camera, image in zip(test.cameras, test.images, strict=True):
        exact = scene.exact(camera)
        assert exact.dtype == torch.uint8
        assert exact.shape == image.shape
        # A sample that grazes an edge may turn with the rounding of the pose.
        differing = ((exact.int() - image.int()).abs().amax(-1) > 1).sum().item()
        assert differing <= 3
    assert find(name).boxes().abs().max() <= 1.2


@pytest.mark.parametrize(("width", "height"), [(96, 96), (96, 54), (54, 96)])
def test_a_model_fills_but_does_not_leave_its_pictures(tmp_path, log, width, height):
    sizes = {"width": width, "height": height, "train": 1, "test": 4}
    scene = embedded.load("totem", **sizes, bounds="full", root=tmp_path, log=log)
    for image in scene.splits["test"].images:
        alpha = image[..., 3]
        border = torch.cat((alpha[0], alpha[-1], alpha[:, 0], alpha[:, -1]))
        assert (border == 0).all()
        assert (alpha > 0).sum() > 0.2 * min(width, height) ** 2


def test_the_orbit_is_smooth_and_closes():
    eyes = torch.stack([pose[:, 3] for pose in orbit_poses(360)])
    steps = (eyes - eyes.roll(1, 0)).norm(dim=1)  # the last step joins the ends
    one_degree = 2 * embedded.DISTANCE * math.sin(math.radians(0.5))
    # Azimuth moves cos(elevation) of a degree, elevation at most 8 * 2 / 57.3 of one.
    assert steps.min() >= one_degree * math.cos(math.radians(33)) * 0.999
    assert steps.max() <= one_degree * math.hypot(math.cos(math.radians(17)), 16 / 57.3) * 1.001


def test_poses_look_at_the_middle_from_10_degrees_below_to_80_above():
    train, orbit = map(torch.stack, (train_poses(200, 3), orbit_poses(360)))
    for poses in (train, orbit):
        torch.testing.assert_close(poses[:, :, 2], -poses[:, :, 3] / embedded.DISTANCE)
    low, high = (math.sin(math.radians(x)) for x in (-10, 80))
    height = train[:, 2, 3] / embedded.DISTANCE
    assert low <= height.min() < low + 0.01 < high - 0.01 < height.max() <= high
    height = (orbit[:, 2, 3] / embedded.DISTANCE).asin().rad2deg()
    assert height.min().item() == pytest.approx(17, abs=0.01)
    assert height.max().item() == pytest.approx(33, abs=0.01)


def test_training_poses_are_those_of_their_seed():
    first, again, other = (train_poses(5, seed) for seed in (0, 0, 1))
    assert all(map(torch.equal, first, again))
    assert not any(map(torch.equal, first, other))


@pytest.mark.parametrize("fault", [KeyboardInterrupt, OSError("no space left on device")])
def test_a_broken_write_leaves_nothing(tmp_path, monkeypatch, log, fault):
    monkeypatch.setattr(embedded, "picture", Mock(side_effect=fault))
    with pytest.raises((KeyboardInterrupt, SteerbenchError)):
        embedded.load("void", **SMALL, root=tmp_path, log=log)
    assert list(tmp_path.iterdir()) == []


def test_a_root_that_cannot_be_written_is_named(tmp_path, log):
    (tmp_path / "file").write_text("")
    with refusal(r"file/void-\w+: the scene cannot be written"):
        embedded.load("void", **SMALL, root=tmp_path / "file", log=log)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"width": 0}, "width: expected a whole number from 1 on, got 0"),
        ({"height": 2.5}, "height: .* got 2.5"),
        ({"test": True}, "test: expected a whole number from 1"),
        ({"seed": -1}, "seed: expected a whole number from 0"),
        ({"name": "tower"}, "one of totem, wires, cloud, void, got 'tower'"),
    ],
)
def test_bad_options(tmp_path, log, options, message):
    with refusal(message):
        embedded.load(**{"name": "void", **options}, root=tmp_path, log=log)
    assert list(tmp_path.iterdir()) == []

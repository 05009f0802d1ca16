"""Scenes as files: what is written is what our own loaders, and others' by their names, read."""

from dataclasses import replace

import pytest
import torch

from bench.scenes import blender, transforms
from bench.scenes.export import write_blender
from tests.common import read_json, write_json


def test_pictures_without_alpha_are_opaque_and_a_split_not_named_has_none(
    moved_scene, log, tmp_path
):
    train = moved_scene.splits["train"]
    masks = [image[..., 0] > 99 for image in train.images]
    opaque = replace(train, images=[image[..., :3] for image in train.images], masks=masks)
    scene = replace(moved_scene, splits={**moved_scene.splits, "train": opaque})
    write_blender(scene, tmp_path, {"train": "train", "test": "train"}, log)
    assert log.messages == [f"{tmp_path}: without the masks of {scene.name}"]
    assert len(list(tmp_path.rglob("*.png"))) == len(train)
    found = blender.load(tmp_path, bounds="full", log=log)
    assert found.splits["test"].names == found.splits["train"].names
    (image, *_) = found.splits["train"].images
    assert (image[..., 3] == 255).all()
    assert torch.equal(image[..., :3], opaque.images[0])


@pytest.mark.parametrize(
    "lens", [{"fy": 61.0}, {"cx": 19.0}, {"fx": 70.0, "fy": 70.0}], ids=["fy", "cx", "one"]
)
def test_lenses_that_one_angle_does_not_describe_are_in_other_fields(
    lens, moved_scene, quiet_log, tmp_path
):
    train = moved_scene.splits["train"]
    count = len(train) if len(lens) == 1 else 1
    cameras = [replace(c, **lens) if n < count else c for n, c in enumerate(train.cameras)]
    scene = replace(moved_scene, splits={"train": replace(train, cameras=cameras)})
    write_blender(scene, tmp_path, {"train": "train", "test": "train"}, quiet_log)

    def lenses(cameras):
        return [(c.fx, c.fy, c.cx, c.cy, c.width, c.height) for c in cameras]

    read = blender.load(tmp_path, bounds="full", log=quiet_log).splits["train"].cameras
    assert lenses(read) == lenses(cameras)
    record = read_json(tmp_path / "transforms_train.json")
    for frame in record["frames"]:
        frame["file_path"] += ".png"
    write_json(tmp_path / "transforms.json", record)
    found = transforms.load(tmp_path, split_every=4, log=quiet_log).splits["test"].cameras
    assert lenses(found)[0] == lenses(cameras)[0]

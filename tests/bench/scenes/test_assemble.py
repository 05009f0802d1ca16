"""Held-out pictures: away from the training, none lost, under another digest."""

from __future__ import annotations

from dataclasses import replace

import pytest

from bench.scenes.assemble import hold_out
from bench.types import Scene, Split, SteerbenchError


def with_training(scene: Scene, count: int) -> Scene:
    """`scene` with `count` different training pictures, called 0, 1, 2 ..."""
    camera, image = scene.splits["train"].cameras[0], scene.splits["train"].images[0]
    cameras = [replace(camera, fx=60.0 + index) for index in range(count)]
    images = [image.roll(index, dims=0) for index in range(count)]
    train = Split(cameras, images, [str(index) for index in range(count)])
    return replace(scene, splits={**scene.splits, "train": train})


@pytest.mark.parametrize(
    ("count", "held"), [(8, ["4"]), (13, ["4", "12"]), (24, ["4", "12", "20"])]
)
def test_each_training_picture_is_either_learned_from_or_held_out(tiny_scene, count, held):
    scene = with_training(tiny_scene, count)
    found = hold_out(scene, "validation", 8)
    parts = [found.splits[name] for name in ("train", "validation")]
    pairs = {
        name: (camera, image)
        for part in parts
        for name, camera, image in zip(part.names, part.cameras, part.images, strict=True)
    }
    train = scene.splits["train"]
    assert parts[1].names == held
    assert sum(map(len, parts)) == len(pairs) == count
    for name, camera, image in zip(train.names, train.cameras, train.images, strict=True):
        assert pairs[name][0] is camera
        assert pairs[name][1] is image
    assert found.splits["test"] is scene.splits["test"]


def test_the_digest_says_that_and_what_is_held_out(tiny_scene):
    scene = with_training(tiny_scene, 16)
    digests = [hold_out(scene, "validation", every).digest for every in (8, 4, 8)]
    assert digests[0] == digests[2]
    assert len({scene.digest, *digests}) == 3
    other = replace(scene, digest="of other pictures")
    assert hold_out(other, "validation", 8).digest != digests[0]


def test_too_few_training_pictures_are_refused(tiny_scene):
    with pytest.raises(SteerbenchError, match=r"split=validation: expected at least 8 .* got 7 of"):
        hold_out(with_training(tiny_scene, 7), "validation", 8)

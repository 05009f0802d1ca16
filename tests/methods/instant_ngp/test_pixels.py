"""Pixels of the training pictures: their rays, which are drawn, and where the error is."""

from dataclasses import replace

import pytest
import torch

from bench.cameras import cast
from bench.types import Split
from methods.instant_ngp.pixels import RUN, STRIP, UNSEEN, ErrorMap, PixelBatches
from tests.common import refusal, seeded

CPU = torch.device("cpu")


def test_rays_of_pictures_of_several_sizes_are_those_of_their_cameras(ball_scene):
    split = ball_scene.splits["train"]
    whole, other = split.cameras[:2]
    # The last strip of the second picture is 3 wide; the third is narrower than a strip.
    cameras = (
        whole,
        replace(other, width=2 * STRIP + 3, height=other.height - 3, fx=2 * other.fx),
        replace(whole, width=5),
    )
    pairs = zip(cameras, split.images, strict=False)
    images = [image[: camera.height, : camera.width] for camera, image in pairs]
    batches = PixelBatches(Split(cameras, images, split.names[:3]), CPU)
    rays, colours = batches.at(torch.arange(len(batches)))
    expected = []
    for camera, image in zip(cameras, images, strict=True):
        of = cast(camera)
        pixels = torch.cat((of.origins, of.directions, image.flatten(0, 1) / 255), dim=1)
        strips = pixels.view(*image.shape[:2], -1).split(STRIP, dim=1)
        expected += [strip.flatten(0, 1) for strip in strips]
    found = torch.cat((rays.origins, rays.directions, colours), dim=1)
    torch.testing.assert_close(found, torch.cat(expected))


def test_every_pixel_is_drawn_once_if_as_many_are_drawn_as_there_are(ball_scene):
    batches = PixelBatches(ball_scene.splits["train"], CPU)
    drawn = batches.choose(len(batches), seeded(0))
    assert torch.equal(drawn, torch.arange(len(batches)))


def test_any_pixel_can_be_drawn(ball_scene):
    batches = PixelBatches(ball_scene.splits["train"], CPU)
    generator = seeded(0)
    # Each has a chance of 1/4: one of N is missed 200 times with a probability below 1e-20 N.
    drawn = torch.cat([batches.choose(len(batches) // 4, generator) for _ in range(200)])
    assert len(drawn.unique()) == len(batches)


def test_an_opaque_picture_among_transparent_ones_is_opaque(ball_scene):
    split = ball_scene.splits["train"]
    images = [split.images[0][..., :3], split.images[1]]
    mixed = Split(split.cameras[:2], images, split.names[:2])
    _, colours = PixelBatches(mixed, CPU).draw(4000, seeded(0))
    transparent = (split.images[1][..., 3] == 0).float().mean().item() / 2
    assert (colours[:, 3] == 0).float().mean().item() == pytest.approx(transparent, abs=0.05)


def test_runs_are_drawn_in_proportion_to_the_root_of_their_error():
    chances = ErrorMap(3 * RUN, CPU)
    chances.errors.copy_(torch.tensor([0.04, 0.0, 0.36]))
    chances.refresh()
    drawn = chances.draw(400, seeded(0)) // RUN
    assert torch.equal(drawn, drawn.sort().values)
    # One from each of 400 equal parts, of which the first 100 belong to the first run.
    assert torch.bincount(drawn, minlength=3).tolist() == pytest.approx([100, 0, 300], abs=1)


def test_all_pixels_of_a_run_can_be_drawn_and_none_beyond_the_last():
    pixels = RUN + 3
    chances = ErrorMap(pixels, CPU)
    drawn = chances.draw(100 * RUN, seeded(0))
    assert torch.equal(drawn.unique(), torch.arange(pixels))


def test_a_new_error_counts_as_much_as_the_estimate():
    chances = ErrorMap(2 * RUN, CPU)
    chances.learn(torch.tensor([0, RUN - 1]), torch.tensor([0.5, 0.3]))
    first = (UNSEEN + 0.5 + 0.3) / 3
    assert chances.errors.tolist() == pytest.approx([first, UNSEEN])
    chances.learn(torch.tensor([1, RUN]), torch.tensor([0.4, 0.0]))
    assert chances.errors.tolist() == pytest.approx([(first + 0.4) / 2, UNSEEN / 2])


def test_masked_pixels_have_no_number(ball_scene):
    split = ball_scene.splits["train"]
    pair = Split(split.cameras[:2], split.images[:2], split.names[:2])
    mask = torch.rand(32, 32, generator=seeded(0)) < 0.5
    (whole, every), (some, fewer) = (
        batches.at(torch.arange(len(batches)))
        for batches in (PixelBatches(x, CPU) for x in (pair, replace(pair, masks=[mask, None])))
    )
    strips = torch.cat([strip.flatten() for strip in mask.split(STRIP, dim=1)])
    kept = torch.cat((strips, torch.ones_like(strips)))
    assert torch.equal(fewer, every[kept])
    assert torch.equal(some.directions, whole.directions[kept])
    with refusal("masks of the training pictures: expected a pixel"):
        PixelBatches(replace(pair, masks=[torch.zeros_like(mask)] * 2), CPU)

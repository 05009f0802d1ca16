"""The mill: a building with thin parts that is as hard to enlarge as one."""

import math

import pytest
import torch
from torch.nn.functional import avg_pool2d, interpolate

from bench.scenes.embedded import ANGLE_X, VIEWS, orbit_poses, picture, train_poses
from bench.scenes.embedded.mill import mill
from bench.scenes.embedded.raytrace import render
from bench.types import Camera

WIDTH, HEIGHT = 1920, 1080


def test_only_the_foot_of_the_mill_is_cut_in_training_pictures():
    model, focal = mill(), 16 / math.tan(ANGLE_X / 2)
    for pose in train_poses(6, 1, VIEWS["mill"]):
        camera = Camera(pose.float(), focal, focal, 16, 9, 32, 18)
        alpha = render(model, camera, torch.ones(3), samples=1).alpha
        assert (torch.cat((alpha[0], alpha[:, 0], alpha[:, -1])) == 0).all()
        assert alpha.mean() > 0.3


def test_thin_parts_are_seen_by_a_field_of_1024_cells_but_only_just():
    whole = mill().boxes().reshape(-1, 3)
    size = (whole.amax(0) - whole.amin(0)).max().item()
    thickness = [2 * min(part.shape.extent()) for part in mill().parts]
    assert size / 350 < min(thickness) < size / 250
    assert sum(x < size / 100 for x in thickness) > 40


@pytest.mark.parametrize("place", [(700, 330), (1000, 520), (800, 700)], ids=str)
def test_the_mill_is_as_hard_to_enlarge_as_photographs(place):
    pose = orbit_poses(24, VIEWS["mill"])[12]
    focal = WIDTH / 2 / math.tan(ANGLE_X / 2)
    x, y = WIDTH / 2 - place[0], HEIGHT / 2 - place[1]
    window = Camera(pose.float(), focal, focal, x, y, 128, 96)  # in the picture at full size
    shown = picture(mill(), window)[..., :3].permute(2, 0, 1)[None].float() / 255
    small = avg_pool2d(shown, 4)
    large = interpolate(small, scale_factor=4, mode="bilinear", align_corners=False)
    error = (large - shown).square().mean().item()
    # On a white background, of which half is seen, 3 dB more.
    assert 18 < -10 * math.log10(error) < 26

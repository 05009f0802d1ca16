"""Cameras: projection undoes casting, and every change of grid or of units keeps the view."""

import math
from dataclasses import replace

import pytest
import torch

from bench.cameras import (
    cast,
    crop_camera,
    frame_camera,
    look_at,
    pack_camera,
    project,
    scale_camera,
    unpack_camera,
)
from bench.types import Camera
from tests.common import assert_near, seeded

FLOAT32 = torch.finfo(torch.float32).eps


def camera_at(eye: tuple[float, float, float]) -> Camera:
    """52 x 36 pixels, off-centre, looking at the middle of the unit cube."""
    up = torch.tensor((0.1, 0.2, 1.0))
    c2w = look_at(torch.tensor(eye), torch.full((3,), 0.5), up)
    return Camera(c2w, fx=60.0, fy=55.0, cx=27.5, cy=16.25, width=52, height=36)


def test_a_quarter_is_undone_exactly_and_its_pixels_look_through_the_middle_of_blocks():
    camera = camera_at((2.0, 2.0, 2.0))
    odd = replace(camera, fx=0.1, cx=1 / 3)
    # Dictionaries take the same tensor as equal; cameras would compare its elements.
    assert vars(scale_camera(scale_camera(odd, 13, 9), 52, 36)) == vars(odd)
    low = cast(scale_camera(camera, 13, 9)).directions.reshape(9, 13, 3)
    high = cast(camera).directions.reshape(9, 4, 13, 4, 3).mean((1, 3))
    assert_near(low, high, atol=16 * FLOAT32)


def test_pixels_keep_their_rays_in_a_crop_and_in_the_middle_of_a_wider_frame():
    camera = camera_at((2.0, 2.0, 2.0))
    whole = cast(camera).directions.reshape(36, 52, 3)
    part = cast(crop_camera(camera, left=5, top=7, width=20, height=11)).directions
    assert_near(part.reshape(11, 20, 3), whole[7:18, 5:25], atol=4 * FLOAT32)
    wide = cast(frame_camera(camera, 52 + 2 * 20, 36)).directions.reshape(36, 92, 3)
    assert_near(wide[:, 20:-20], whole, atol=4 * FLOAT32)
    assert vars(frame_camera(camera, 104, 72)) == vars(scale_camera(camera, 104, 72))


def test_look_at_centres_the_target_with_up_upward():
    camera = camera_at((3.0, -2.0, 1.0))
    pixels, depth = project(camera, torch.tensor([[0.5, 0.5, 0.5], [0.5, 0.5, 0.7]]))
    assert pixels[0].tolist() == pytest.approx([camera.cx, camera.cy], abs=1e-4)
    assert depth[0].item() == pytest.approx(math.dist((3, -2, 1), (0.5, 0.5, 0.5)), rel=1e-6)
    assert pixels[1, 1] < pixels[0, 1]
    rotation = camera.c2w[:, :3]
    assert torch.linalg.det(rotation).item() == pytest.approx(1, abs=1e-6)


def test_a_packed_camera_comes_back_to_the_last_bit():
    c2w = torch.randn(3, 4, generator=seeded(0))
    camera = Camera(c2w, 1 / 3, 700.1, -2.7, 1e-9, 4097, 3)
    again = unpack_camera(pack_camera(camera))
    assert torch.equal(again.c2w, c2w)
    assert vars(replace(again, c2w=c2w)) == vars(camera)

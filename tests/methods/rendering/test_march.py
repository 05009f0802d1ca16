"""The step that suits the pictures of a scene."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from bench.cameras import scale_camera
from bench.types import Scene
from methods.instant_ngp.training import MarchOptions
from methods.rendering.march import suitable_step
from methods.rendering.occupancy import RESOLUTION, STEP

CELL = 1 / RESOLUTION


def seen_by(scene: Scene, pixels: int, distance: float) -> Scene:
    """`scene`, by cameras with square pictures whose middle lies at `distance`."""
    split = scene.splits["train"]
    middle = scene.bounds.mean(dim=0)
    cameras = []
    for camera in split.cameras:
        c2w = camera.c2w.clone()
        away = c2w[:, 3] - middle
        c2w[:, 3] = middle + away * (distance / away.norm())
        scaled = scale_camera(camera, pixels, pixels)
        cameras.append(replace(scaled, c2w=c2w, fx=float(pixels), fy=float(pixels)))
    return replace(scene, splits={"train": replace(split, cameras=cameras)})


def test_it_is_the_geometric_mean_of_a_pixel_and_a_cell(tiny_scene: Scene) -> None:
    # From so far away that the corners of the scene are as far as its middle, to 1 in 1,000.
    step = suitable_step(seen_by(tiny_scene, 16_000, distance=40.0))
    assert step == pytest.approx(math.sqrt(40 / 16_000 * CELL), rel=1e-3)


def test_twice_the_pixels_are_steps_shorter_by_the_root_of_two(tiny_scene: Scene) -> None:
    coarse, fine = (suitable_step(seen_by(tiny_scene, size, 1.5)) for size in (400, 800))
    assert coarse / fine == pytest.approx(math.sqrt(2), rel=1e-5)


def test_pixels_wider_than_a_cell_get_steps_of_a_cell(tiny_scene: Scene) -> None:
    assert suitable_step(seen_by(tiny_scene, 32, 1.5)) == pytest.approx(CELL)


def test_a_camera_in_the_middle_sees_what_is_around_it(tiny_scene: Scene) -> None:
    inside = seen_by(tiny_scene, 800, 1e-6)
    half = (inside.bounds[1] - inside.bounds[0]).norm().item() / 2
    assert suitable_step(inside) == pytest.approx(math.sqrt(half / 800 * CELL), rel=1e-3)


def test_a_training_takes_the_step_that_it_is_told_and_else_the_suitable_one(
    tiny_scene: Scene,
) -> None:
    assert MarchOptions(march_step=3.0).march(tiny_scene).step == 3 * STEP
    assert MarchOptions().march(tiny_scene).step == suitable_step(tiny_scene)
    with pytest.raises(ValueError, match="march_step: expected a length of more than 0"):
        MarchOptions(march_step=0.0)

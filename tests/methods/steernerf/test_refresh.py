"""Adaptive refresh: which pixels are taken over, what they then show, and for how long."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from tests.methods.test_pipeline import OPTIONS, new_pipeline
from torch import Tensor

from bench.cameras import pixel_grid
from bench.types import Camera
from methods.kernels.march import Occupancy
from methods.rendering.batch import FeatureFrame
from methods.steernerf.buffer import Cloud, RenderingBuffer, Reprojection
from methods.steernerf.range_reduction import RangeReduction
from methods.steernerf.refresh import (
    BLOCK,
    DEPTH_TOLERANCE,
    OPAQUE,
    Known,
    Refresh,
    first_ages,
    inside_surface,
    known_pixels,
)
from tests.methods.conftest import Work, look_at_the_middle
from tests.methods.solids import Solid, ball

EXACT = Reprojection()
SIZE = 16
FOCAL = 40.0
DISTANCE = 1.5
EVERYWHERE = Occupancy(torch.ones(32, 32, 32, dtype=torch.bool))
PIXEL = DISTANCE / FOCAL
"""Side of a pixel on a wall at `DISTANCE`, in scene units."""


def facing_a_wall(aside: float = 0.0) -> Camera:
    """Looks along x, moved by `aside` pixels to the right."""
    c2w = torch.tensor([[0.0, 0, 1, 0], [-1, 0, 0, 0.5 - aside * PIXEL], [0, -1, 0, 0.5]])
    return Camera(c2w, FOCAL, FOCAL, SIZE / 2, SIZE / 2, SIZE, SIZE)


def at_the_wall(values: Tensor, alpha: float = 1.0) -> FeatureFrame:
    """What `facing_a_wall()` sees on it: `values` [SIZE, SIZE, K]."""
    flat = torch.full((SIZE, SIZE), DISTANCE), torch.full((SIZE, SIZE), alpha)
    return FeatureFrame(facing_a_wall(), values, *flat)


def shading(slope: float) -> Tensor:
    """Features that grow from left to right, by `slope` a pixel, and from top to bottom by half."""
    place = pixel_grid(SIZE, SIZE).view(SIZE, SIZE, 2)
    along = 0.1 + slope * (place[..., 0] + place[..., 1] / 2)
    return torch.stack((along, 1 - along, along / 2, along), dim=-1)


def known_at(
    frame: FeatureFrame, camera: Camera, options: Refresh, age: Tensor | None = None
) -> Known:
    return known_pixels(Cloud.of(frame, EXACT, age), camera, options, EXACT, "cpu")


@pytest.mark.parametrize("aside", [0.0, 0.25, 0.4, 1.0, 1.75])
def test_between_samples_even_shading_is_interpolated_exactly(aside: float) -> None:
    slope, shift = 0.01, torch.tensor([1, -1, 0.5, 1])
    camera = facing_a_wall(aside)
    known = known_at(at_the_wall(shading(slope)), camera, Refresh(age=1, tolerance=slope))
    assert len(known.pixels) >= (SIZE - 4) ** 2
    want = shading(slope).flatten(0, 1)[known.pixels] + slope * aside * shift
    # Places and depths are off by some ulps of 16 pixels.
    torch.testing.assert_close(known.values, want, rtol=0, atol=1e-5)
    torch.testing.assert_close(known.depth, torch.full_like(known.depth, DISTANCE))
    assert (known.alpha > 1 - 1e-5).all()
    assert (known.age == 1).all()


def test_what_lies_between_samples_that_differ_is_rendered_but_not_the_samples() -> None:
    torch.manual_seed(0)
    frame, options = at_the_wall(torch.rand(SIZE, SIZE, 4)), Refresh(age=1)
    standing = known_at(frame, facing_a_wall(), options)
    assert len(standing.pixels) >= (SIZE - 4) ** 2
    assert len(known_at(frame, facing_a_wall(0.4), options).pixels) == 0


def test_taken_over_pixels_differ_from_the_nearest_sample_by_the_tolerance_at_most() -> None:
    torch.manual_seed(0)
    frame, tolerance = at_the_wall(0.05 * torch.rand(SIZE, SIZE, 4)), 0.01
    known = known_at(frame, facing_a_wall(0.25), Refresh(age=1, tolerance=tolerance))
    assert 5 < len(known.pixels) < (SIZE - 1) ** 2
    apart = (known.values - frame.values.flatten(0, 1)[known.pixels]).abs()
    assert apart.max() <= tolerance + 1e-6


def test_depths_that_differ_more_than_neighbours_may_are_not_interpolated() -> None:
    step, camera = 3 * DEPTH_TOLERANCE, facing_a_wall()  # less than an edge
    depth = torch.full((SIZE, SIZE), DISTANCE)
    depth[:, SIZE // 2 :] += step
    frame = replace(at_the_wall(shading(0.0)), depth=depth)
    assert inside_surface(depth)[1:-1, 1:-1].all()
    moved = facing_a_wall(0.4)
    known = torch.zeros(SIZE * SIZE, dtype=torch.bool)
    known[known_at(frame, moved, Refresh(age=1)).pixels] = True
    columns = known.view(SIZE, SIZE)[2:-2].all(dim=0)
    assert columns[2 : SIZE // 2 - 2].all()
    assert not columns[SIZE // 2 - 1]
    standing = known_at(frame, camera, Refresh(age=1))
    torch.testing.assert_close(standing.depth, depth.flatten()[standing.pixels])


@pytest.mark.parametrize("alpha", [OPAQUE - 0.01, OPAQUE + 0.01])
def test_only_what_is_opaque_is_taken_over(alpha: float) -> None:
    known = known_at(at_the_wall(shading(0.0), alpha), facing_a_wall(), Refresh(age=1))
    assert (len(known.pixels) > 0) == (alpha > OPAQUE)


def test_nothing_is_taken_over_beside_an_edge_or_an_outline_but_beside_a_hole() -> None:
    depth = torch.full((8, 9), 1.0)
    depth[:, 4:] = 2.0
    depth[6:] = torch.inf
    depth[2, 1] = torch.inf
    inside = inside_surface(depth)
    want = torch.zeros_like(inside)
    want[:5, :3] = want[:5, 5:] = True
    want[2, 1] = False
    assert torch.equal(inside, want)


def test_a_pixel_is_as_old_as_the_oldest_of_its_samples_and_not_too_old() -> None:
    frame, most = at_the_wall(shading(0.0)), 3
    ages = torch.zeros(SIZE, SIZE, dtype=torch.uint8)
    ages[:, 6], ages[:, 10] = most - 1, most
    known = known_at(frame, facing_a_wall(0.4), Refresh(age=most), ages.flatten())
    got = known.ages(facing_a_wall()).view(SIZE, SIZE)[2:-2, 2:-2]
    # Pixel i is between the samples i and i + 1.
    assert (got[:, [5 - 2, 6 - 2]] == most).all()
    assert (got[:, [9 - 2, 10 - 2]] == 0).all()  # rendered
    assert (got[:, 2:3] == 1).all()


def test_after_a_cold_start_as_many_pixels_grow_too_old_in_one_frame_as_in_another() -> None:
    options = Refresh(age=3)
    size = 4 * BLOCK
    ages = first_ages(
        replace(facing_a_wall(), width=size, height=size), options, torch.device("cpu")
    )
    assert ages.bincount().tolist() == [size * size // 4] * 4


def test_an_empty_frame_says_nothing() -> None:
    empty = at_the_wall(shading(0.0), alpha=0.0)
    assert len(known_at(empty, facing_a_wall(), Refresh(age=1)).pixels) == 0


@pytest.mark.parametrize("age", [1, 3])
@pytest.mark.parametrize("mode", ["off", "window"])
def test_a_camera_that_stands_still_comes_to_see_what_is_rendered_anew(age: int, mode: str) -> None:
    """Whatever the frames showed while it moved: after `age` more, every ray has been rendered."""
    options = replace(
        OPTIONS, steps=1, refresh=Refresh(age, tolerance=1.0), range=RangeReduction(mode)
    )
    refreshed, whole = new_pipeline(options), new_pipeline(replace(options, refresh=Refresh()))
    for pipeline in (refreshed, whole):
        pipeline.field, pipeline.occupancy = Solid(ball()), EVERYWHERE
    path = [look_at_the_middle(0.1 + 0.004 * i, 0.3) for i in range(4)]
    path = [replace(camera, width=128, height=128, cx=64, cy=64, fx=240, fy=240) for camera in path]
    path += path[-1:] * (age + options.frames)
    work = [Work(), Work()]
    buffers = [RenderingBuffer(options.frames) for _ in work]
    apart = []
    for camera in path:
        for pipeline, buffer, probe in zip((refreshed, whole), buffers, work, strict=True):
            pipeline.render(camera, buffer, probe)
        assert buffers[0].frames[0].cloud.age.max() <= age
        ours, exact = (buffer.frames[0].cloud for buffer in buffers)
        assert torch.equal(ours.source, exact.source)
        apart.append((ours.values - exact.values).abs().max().item())
    assert work[0].done["known_pixels"] > len(ours.source) * len(path) / 8
    # Interpolated once, and by weights some ulps of 16 pixels off 0 and 1 of features in [0, 1].
    assert max(apart[1:4]) > 1e-3
    assert max(apart[-options.frames :]) < age * 1e-4


def test_a_frame_that_was_left_out_between_is_not_skipped_over() -> None:
    """After a glance to the other side, what lies before it is two frames old."""
    options = replace(OPTIONS, steps=1, overlap=0.5, refresh=Refresh(age=3, tolerance=1.0))
    pipeline, buffer = new_pipeline(options), RenderingBuffer(2)
    pipeline.field, pipeline.occupancy = Solid(ball()), EVERYWHERE
    here, there = (
        replace(look_at_the_middle(turn, lift), width=128, height=128, cx=64, cy=64, fx=240, fy=240)
        for turn, lift in ((0.1, 0.3), (0.6, -0.3))
    )
    known = []
    for camera in (here, here, there, here, here):
        work = Work()
        pipeline.render(camera, buffer, work)
        known.append(work.done["known_pixels"] > 0)
    assert known == [False, True, False, False, True]


def test_what_cannot_be_refreshed_adaptively_is_refused() -> None:
    for wrong in ({"frames": 0}, {"reprojection": Reprojection(rule="last")}):
        with pytest.raises(ValueError, match=r"refresh\.age: expected 0 .*, got 2"):
            replace(OPTIONS, refresh=Refresh(age=2), **wrong)
    with pytest.raises(ValueError, match=r"refresh\.age: expected 0 to 255 frames, got 256"):
        Refresh(age=256)
    with pytest.raises(ValueError, match=r"refresh\.tolerance: expected 0 to 1, got 2"):
        Refresh(tolerance=2)

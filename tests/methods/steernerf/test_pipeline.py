"""A frame of the pipeline: views, cold start, what follows what, what is chosen afterwards."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Literal

import pytest
import torch

from bench.cameras import cast, project
from bench.probes import StageClock
from bench.types import Camera, NullProbe
from methods.kernels.types import Occupancy
from methods.rendering.frame import everywhere, render_frame
from methods.rendering.occupancy import STEP
from methods.rendering.sampling import Sampling
from methods.steernerf.buffer import Cloud, Remembered, RenderingBuffer
from methods.steernerf.options import SIZES, RangeReduction, Reprojection, Skips
from methods.steernerf.unet import UNet
from methods.steernerf.view import View
from methods.steernerf_lean.cells import cells_near, pixels_of
from methods.steernerf_lean.kernels.warp import enlarge
from methods.steernerf_lean.refinement import worst_cells
from tests.methods.conftest import Work, look_at_the_middle
from tests.methods.models import new_pipeline, small_model, small_rendering
from tests.methods.observations import shaken

USUAL = small_rendering()
CAMERA = look_at_the_middle(0.1, 0.3)
Mode = Literal["off", "window"]
ALL_CELLS = torch.arange(64)
"""Of its 32 x 32 pixels."""


@pytest.mark.parametrize("size", [(32, 32), (33, 30)])
def test_a_ray_of_the_low_resolution_goes_through_the_middle_of_its_cell(
    size: tuple[int, int],
) -> None:
    view = View.of(replace(CAMERA, width=size[0], height=size[1]), 4)
    assert (view.full.width, view.full.height) == (4 * view.low.width, 4 * view.low.height)
    rays = cast(view.low)
    pixels, _ = project(view.full, rays.origins + 2 * rays.directions)
    assert torch.allclose(pixels[0], torch.tensor((2.0, 2.0)), atol=1e-4)  # float32 at 32 pixels
    assert torch.allclose(pixels[1] - pixels[0], torch.tensor((4.0, 0.0)), atol=1e-4)


def test_a_part_of_a_view_looks_as_the_view_does() -> None:
    view = View.of(CAMERA, 4)
    part = view.crop(2, 3, 4, 5)
    assert (part.low.width, part.low.height, part.scale) == (4, 5, 4)
    assert (part.full.width, part.full.height) == (16, 20)
    for whole, some, scale in ((view.low, part.low, 1), (view.full, part.full, 4)):
        directions = cast(whole).directions.view(whole.height, whole.width, 3)
        there = directions[3 * scale : 8 * scale, 2 * scale : 6 * scale]
        got = cast(some).directions.view(some.height, some.width, 3)
        torch.testing.assert_close(got, there, rtol=0, atol=1e-6)


@pytest.mark.parametrize("frames", [0, 1, 3])
@pytest.mark.parametrize("size", [(32, 32), (33, 30), (5, 3)])
def test_frames_have_the_size_of_the_camera_whatever_is_remembered(
    frames: int, size: tuple[int, int]
) -> None:
    pipeline = new_pipeline(small_model(frames=frames))
    camera = replace(CAMERA, width=size[0], height=size[1])
    buffer = RenderingBuffer(frames)
    for remembered in range(frames + 2):
        assert len(buffer.frames) == min(remembered, frames)
        frame = pipeline.render(camera, buffer, USUAL, NullProbe())
        assert frame.rgb.shape == (size[1], size[0], 3)
        assert frame.depth.shape == frame.alpha.shape == (size[1], size[0])
        assert frame.rgb.isfinite().all()


def test_after_a_reset_a_sequence_repeats_bit_for_bit() -> None:
    pipeline = new_pipeline()
    cameras = [look_at_the_middle(0.1 + 0.003 * i, 0.3) for i in range(4)]
    buffer = RenderingBuffer(2)
    first = [pipeline.render(camera, buffer, USUAL, NullProbe()).rgb for camera in cameras]
    buffer.reset()
    second = [pipeline.render(camera, buffer, USUAL, NullProbe()).rgb for camera in cameras]
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))
    third = pipeline.render(cameras[0], buffer, USUAL, NullProbe()).rgb
    assert not torch.equal(third, first[0])  # it remembers


def test_the_preceding_picture_of_a_still_camera_is_where_it_was() -> None:
    pipeline = new_pipeline()
    buffer = RenderingBuffer(2)
    frame = pipeline.render(CAMERA, buffer, USUAL, NullProbe())
    view = View.of(CAMERA, 4)
    low_depth = frame.depth[::4, ::4]
    fine = enlarge(low_depth, ALL_CELLS, 4)
    newest = buffer.frames[0]
    assert newest.picture is not None
    history = pipeline._history(newest, newest.picture, fine, ALL_CELLS, view)
    blocks = frame.rgb.view(8, 4, 8, 4, 3).transpose(1, 2).reshape(64, 16, 3)
    known = history.valid > 0
    assert known.float().mean() > 0.2
    # Positions are off by some ulps of 32 pixels, and neighbours differ by at most 1.
    assert (history.values - blocks)[known].abs().max() < 1e-4


@pytest.mark.parametrize("mode", ["paper", "window"])
def test_of_a_sum_of_depths_range_reduction_reprojects_what_it_is_told_to(
    mode: Literal["paper", "window"],
) -> None:
    """Expected depths are those of a cloud that has them instead."""
    pipeline = new_pipeline(small_model(reprojection=Reprojection(depth="sum")))
    buffer, probe = RenderingBuffer(2), NullProbe()
    pipeline.render(CAMERA, buffer, USUAL, probe)
    newest, view = buffer.frames[0], pipeline.view(look_at_the_middle(0.15, 0.3))
    mended = replace(newest, cloud=newest.cloud.expected())

    def values(remembered: Remembered, depth: Literal["sum", "expected"]) -> torch.Tensor:
        reduction = RangeReduction(mode, epsilon=0.02, depth=depth)
        rendering = replace(USUAL, range=reduction)
        return pipeline.features(view, (remembered,), rendering, probe).values

    expected = values(newest, "expected")
    assert torch.equal(expected, values(mended, "sum"))
    assert not torch.equal(expected, values(newest, "sum"))


@pytest.mark.parametrize("mode", ["off", "window"])
def test_where_every_cell_is_refined_the_picture_is_that_of_the_field(mode: Mode) -> None:
    rendering = replace(
        USUAL, refined=1.0, refined_step=4.0, range=RangeReduction(mode, epsilon=1.0)
    )
    pipeline, buffer, probe = new_pipeline(), RenderingBuffer(2), NullProbe()
    shown = pipeline.render(CAMERA, buffer, rendering, probe).rgb
    render = everywhere(pipeline.field, pipeline.occupancy, probe, Sampling(step=4.0 * STEP))
    field = render_frame(CAMERA, pipeline.occupancy, pipeline.background, probe, render)
    low = pipeline.features(pipeline.view(CAMERA), (), rendering, probe)
    drawn = cells_near(low.alpha > 0).flatten().nonzero().squeeze(1)
    assert 10 < len(drawn) < 64
    want = pixels_of(field.values[..., :3], drawn, 4)
    assert want.std() > 0.01
    # The same rays among others: products of bfloat16 may be added up in another order.
    torch.testing.assert_close(pixels_of(shown, drawn, 4), want, rtol=0, atol=1e-3)
    assert torch.equal(buffer.frames[0].picture, shown)  # and that is what is remembered


def test_the_cells_with_the_largest_estimated_error_are_refined() -> None:
    """A share of them, rounded up; the others stay as they were drawn."""
    share = 0.1
    pipeline, probe, view = new_pipeline(), NullProbe(), View.of(CAMERA, 4)
    shaken(pipeline.renderer)
    pictures = [
        pipeline.render(CAMERA, RenderingBuffer(2), replace(USUAL, refined=part), probe).rgb
        for part in (0.0, share)
    ]
    frame = pipeline.features(view, (), USUAL, probe)
    observation = pipeline.observe(frame, [], None, view, USUAL, probe)
    error = pipeline.renderer([observation]).error
    assert error is not None
    order = error.sort(descending=True).indices
    count = math.ceil(share * len(order))
    before, after = (pixels_of(picture, observation.cells, 4) for picture in pictures)
    changed = (before != after).flatten(1).any(dim=1)
    assert set(worst_cells(error, share).tolist()) == set(order[:count].tolist())
    assert set(changed.nonzero().flatten().tolist()) <= set(order[:count].tolist())
    assert changed.sum() > 0.5 * count


def test_where_nothing_is_in_sight_nothing_is_refined() -> None:
    pipeline = new_pipeline()
    pipeline.occupancy = Occupancy(torch.zeros_like(pipeline.occupancy.cells))
    frame = pipeline.render(CAMERA, RenderingBuffer(2), replace(USUAL, refined=0.1), NullProbe())
    assert torch.equal(frame.rgb, pipeline.background[:3].expand_as(frame.rgb))


def test_a_frame_that_shows_too_little_of_the_present_view_is_as_if_forgotten() -> None:
    """After a jump to the other side, and back at once: what lay before it is used again."""
    here, there = look_at_the_middle(0.1, 0.3), look_at_the_middle(0.6, -0.3)
    path = [here, there, here]
    used, pictures = {}, {}
    for overlap in (0.0, 0.5):
        rendering = replace(USUAL, overlap=overlap, range=RangeReduction("window"))
        pipeline, buffer, probe = new_pipeline(), RenderingBuffer(2), Work()
        pictures[overlap] = [
            pipeline.render(camera, buffer, rendering, probe).rgb for camera in path
        ]
        used[overlap] = probe.done["preceding_frames"]
    assert used == {0.0: 0 + 1 + 2, 0.5: 0 + 0 + 1}
    cold = new_pipeline().render(there, RenderingBuffer(2), rendering, NullProbe()).rgb
    assert torch.equal(pictures[0.5][1], cold)
    assert not torch.equal(pictures[0.0][1], cold)


def test_the_time_to_see_what_frames_share_is_that_of_a_stage(monkeypatch) -> None:
    """On a clock that stands still but for this."""
    now = [0]

    def overlap(cloud: Cloud, camera: Camera) -> torch.Tensor:
        now[0] += 1
        return torch.ones(())

    monkeypatch.setattr(Cloud, "overlap", overlap)
    clock, buffer = StageClock("cpu", lambda: now[0]), RenderingBuffer(2)
    pipeline, rendering = new_pipeline(), replace(USUAL, overlap=0.5)
    for angle in (0.1, 0.2, 0.3):
        with clock.frame():
            pipeline.render(look_at_the_middle(angle, 0.3), buffer, rendering, clock)
    assert [frame.total_ns for frame in clock.frames] == [0, 1, 2]
    assert [frame.stages_ns["other"] for frame in clock.frames] == [0, 0, 0]


def test_a_renderer_that_does_not_estimate_its_error_is_not_refined() -> None:
    pipeline = new_pipeline(small_model(history=False, surface=False))
    pipeline.renderer = UNet(4, 2, 4)
    pictures = [
        pipeline.render(CAMERA, RenderingBuffer(2), replace(USUAL, refined=share), NullProbe()).rgb
        for share in (0.0, 1.0)
    ]
    assert torch.equal(*pictures)


@pytest.mark.parametrize("name", SIZES)
def test_sizes_that_make_no_frame_are_refused(name: str) -> None:
    least, most = SIZES[name]
    for wrong in (least - 1, most + 1):
        with pytest.raises(ValueError, match=f"{name}: expected {least} to {most}, got {wrong}"):
            small_model(**{name: wrong})


@pytest.mark.parametrize(
    ("make", "name"),
    [(small_model, "step"), (small_rendering, "step"), (small_rendering, "refined_step")],
)
def test_a_step_has_a_length(make, name: str) -> None:
    with pytest.raises(ValueError, match=f"^{name}: expected a length of more than 0, got 0.0"):
        make(**{name: 0.0})


def test_a_share_of_cells_is_between_0_and_1() -> None:
    with pytest.raises(ValueError, match=r"refined: expected a share of 0 to 1, got 1\.5"):
        small_rendering(refined=1.5)
    with pytest.raises(ValueError, match=r"overlap: expected a share of 0 to 1, got -0\.5"):
        small_rendering(overlap=-0.5)
    for make in (small_model, small_rendering):
        with pytest.raises(ValueError, match=r"stop: expected a transmittance .* got 1\.0"):
            make(stop=1.0)


@pytest.mark.parametrize(
    ("skip", "work"),
    [
        (Skips(empty=False), "samples"),
        (Skips(hidden=False), "samples"),
        (Skips(background=False), "cells"),
    ],
)
def test_what_is_not_skipped_is_more_work(skip: Skips, work: str) -> None:
    done = []
    for skips in (Skips(), skip):
        probe, rendering = Work(), replace(USUAL, stop=0.5, skip=skips)
        new_pipeline().render(CAMERA, RenderingBuffer(2), rendering, probe)
        done.append(probe.done)
    assert done[1][work] > done[0][work] > 0


def test_a_longer_step_and_an_earlier_stop_are_less_work() -> None:
    """Chosen after the training, of low-resolution rays and of refined ones."""

    def samples(**others: float) -> int:
        probe = Work()
        new_pipeline().render(CAMERA, RenderingBuffer(2), replace(USUAL, **others), probe)
        return probe.done["samples"]

    usual = samples()
    assert samples(step=16.0) < 0.7 * usual
    assert samples(stop=0.5) < usual
    refined = samples(refined=0.5)
    assert usual < samples(refined=0.5, refined_step=4.0) < refined

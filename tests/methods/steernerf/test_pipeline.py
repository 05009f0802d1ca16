"""A frame of the pipeline: views, phases, cold start, what follows what."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Literal

import pytest
import torch
from tests.methods.test_joint import misty_field, shell

from bench.cameras import cast, project
from bench.probes import StageClock
from bench.types import Camera, NullProbe
from methods.kernels.warp import enlarge
from methods.rendering.occupancy import STEP
from methods.steernerf.beyond.cells import cells_near, pixels_of
from methods.steernerf.beyond.lean_renderer import SpaceToDepth
from methods.steernerf.buffer import Cloud, RenderingBuffer
from methods.steernerf.options import SIZES, PipelineOptions, Skips
from methods.steernerf.pipeline import Pipeline
from methods.steernerf.range_reduction import RangeReduction, render_guided
from methods.steernerf.unet import UnetRelease
from methods.steernerf.view import View, sample_phase
from tests.methods.conftest import GRID, Work, look_at_the_middle
from tests.methods.observations import shaken

OPTIONS = PipelineOptions(channels=4, frames=2, steps=8)
CAMERA = look_at_the_middle(0.1, 0.3)
Mode = Literal["off", "window"]
ALL_CELLS = torch.arange(64)
"""Of its 32 x 32 pixels."""


def new_pipeline(options: PipelineOptions = OPTIONS) -> Pipeline:
    torch.manual_seed(0)
    renderer = SpaceToDepth(
        options.channels,
        options.frames,
        options.scale,
        width=8,
        blocks=1,
        init="scratch",
        history=options.history,
        surface=options.surface,
    )
    field = misty_field(channels=options.channels)
    return Pipeline(field, shell(), torch.ones(3), renderer, options)


@pytest.mark.parametrize("scale", [1, 2, 4, 8])
def test_the_phases_of_a_round_visit_every_pixel_of_a_cell_once(scale: int) -> None:
    phases = {sample_phase(turn, scale) for turn in range(scale**2)}
    middle = (scale - 1) / 2
    assert phases == {(u - middle, v - middle) for u in range(scale) for v in range(scale)}
    assert sample_phase(scale**2, scale) == sample_phase(0, scale)


@pytest.mark.parametrize("size", [(32, 32), (33, 30)])
def test_a_ray_of_the_low_resolution_goes_through_the_middle_of_its_cell_and_the_phase(
    size: tuple[int, int],
) -> None:
    camera = replace(CAMERA, width=size[0], height=size[1])
    for turn in range(16):
        view = View.of(camera, 4, turn, jitter=True)
        assert (view.full.width, view.full.height) == (4 * view.low.width, 4 * view.low.height)
        rays = cast(view.low)
        pixels, _ = project(view.full, rays.origins + 2 * rays.directions)
        first = torch.tensor((2.0, 2.0)) + torch.tensor(view.phase)
        assert torch.allclose(pixels[0], first, atol=1e-4)  # float32 at 32 pixels
        assert torch.allclose(pixels[1] - pixels[0], torch.tensor((4.0, 0.0)), atol=1e-4)


@pytest.mark.parametrize("frames", [0, 1, 3])
@pytest.mark.parametrize("size", [(32, 32), (33, 30), (5, 3)])
def test_frames_have_the_size_of_the_camera_whatever_is_remembered(
    frames: int, size: tuple[int, int]
) -> None:
    pipeline = new_pipeline(replace(OPTIONS, frames=frames))
    camera = replace(CAMERA, width=size[0], height=size[1])
    buffer = RenderingBuffer(frames)
    for remembered in range(frames + 2):
        assert len(buffer.frames) == min(remembered, frames)
        frame = pipeline.render(camera, buffer, NullProbe())
        assert frame.rgb.shape == (size[1], size[0], 3)
        assert frame.depth.shape == frame.alpha.shape == (size[1], size[0])
        assert frame.rgb.isfinite().all()


def test_after_a_reset_a_sequence_repeats_bit_for_bit() -> None:
    pipeline = new_pipeline(replace(OPTIONS, jitter=True))
    cameras = [look_at_the_middle(0.1 + 0.003 * i, 0.3) for i in range(4)]
    buffer = RenderingBuffer(2)
    first = [pipeline.render(camera, buffer, NullProbe()).rgb for camera in cameras]
    buffer.reset()
    second = [pipeline.render(camera, buffer, NullProbe()).rgb for camera in cameras]
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))
    third = pipeline.render(cameras[0], buffer, NullProbe()).rgb
    assert not torch.equal(third, first[0])  # it remembers


def test_the_preceding_picture_of_a_still_camera_is_where_it_was() -> None:
    pipeline = new_pipeline()
    buffer = RenderingBuffer(2)
    frame = pipeline.render(CAMERA, buffer, NullProbe())
    view = View.of(CAMERA, 4, 1)
    low_depth = frame.depth[::4, ::4]
    fine = enlarge(low_depth, ALL_CELLS, 4)
    history = pipeline.history(buffer.frames[0], fine, ALL_CELLS, view)
    blocks = frame.rgb.view(8, 4, 8, 4, 3).transpose(1, 2).reshape(64, 16, 3)
    known = history.valid > 0
    assert known.float().mean() > 0.2
    # Positions are off by some ulps of 32 pixels, and neighbours differ by at most 1.
    assert (history.values - blocks)[known].abs().max() < 1e-4


@pytest.mark.parametrize("mode", ["off", "window"])
def test_where_every_cell_is_refined_the_picture_is_that_of_the_field(mode: Mode) -> None:
    range_ = RangeReduction(mode, epsilon=1.0)
    options = replace(OPTIONS, refined=1.0, refined_steps=4.0, range=range_)
    pipeline, buffer = new_pipeline(options), RenderingBuffer(2)
    shown = pipeline.render(CAMERA, buffer, NullProbe()).rgb
    field = render_guided(
        pipeline.field,
        CAMERA,
        pipeline.occupancy,
        pipeline.background,
        NullProbe(),
        None,
        step=options.refined_steps * STEP,
    )
    drawn = cells_near(pipeline.glance(CAMERA, (), 0, NullProbe()).features.alpha > 0)
    assert 10 < len(drawn) < 64
    want = pixels_of(field.values[..., :3], drawn, 4)
    assert want.std() > 0.01
    # The same rays among others: products of bfloat16 may be added up in another order.
    torch.testing.assert_close(pixels_of(shown, drawn, 4), want, rtol=0, atol=1e-3)
    assert torch.equal(buffer.frames[0].picture, shown)  # and that is what is remembered


def test_the_cells_in_most_doubt_are_refined() -> None:
    """A share of them, rounded up; the others stay as they were drawn."""
    share = 0.1
    drawn, refined = (new_pipeline(replace(OPTIONS, refined=part)) for part in (0.0, share))
    refined.renderer = shaken(drawn.renderer)
    pictures = [p.render(CAMERA, RenderingBuffer(2), NullProbe()).rgb for p in (drawn, refined)]
    view = View.of(CAMERA, 4)
    frame = drawn.glance(CAMERA, (), 0, NullProbe()).features
    sight = drawn.sight(frame, [], view, NullProbe())
    observation = drawn.observe(frame, [], None, view, sight, NullProbe())
    doubt = drawn.renderer([observation]).doubt
    assert doubt is not None
    order = doubt.sort(descending=True).indices
    count = math.ceil(share * len(order))
    before, after = (pixels_of(picture, observation.cells, 4) for picture in pictures)
    changed = (before != after).flatten(1).any(dim=1)
    assert set(changed.nonzero().flatten().tolist()) <= set(order[:count].tolist())
    assert changed.sum() > 0.5 * count


def test_a_frame_that_shows_too_little_of_the_present_view_is_as_if_forgotten() -> None:
    """After a jump to the other side, and back at once: what lay before it is used again."""
    here, there = look_at_the_middle(0.1, 0.3), look_at_the_middle(0.6, -0.3)
    path = [here, there, here]
    used, pictures = {}, {}
    for overlap in (0.0, 0.5):
        options = replace(OPTIONS, overlap=overlap, range=RangeReduction("window"))
        pipeline, buffer, probe = new_pipeline(options), RenderingBuffer(2), Work()
        pictures[overlap] = [pipeline.render(camera, buffer, probe).rgb for camera in path]
        used[overlap] = probe.done["preceding_frames"]
    assert used == {0.0: 0 + 1 + 2, 0.5: 0 + 0 + 1}
    cold = new_pipeline(options).render(there, RenderingBuffer(2), NullProbe()).rgb
    assert torch.equal(pictures[0.5][1], cold)
    assert not torch.equal(pictures[0.0][1], cold)


def test_the_time_to_see_what_frames_share_is_that_of_a_stage(monkeypatch) -> None:
    """On a clock that stands still but for this."""
    now = [0]

    def overlap(cloud: Cloud, camera: Camera) -> float:
        now[0] += 1
        return 1.0

    monkeypatch.setattr(Cloud, "overlap", overlap)
    clock, buffer = StageClock("cpu", lambda: now[0]), RenderingBuffer(2)
    pipeline = new_pipeline(replace(OPTIONS, overlap=0.5))
    for angle in (0.1, 0.2, 0.3):
        with clock.frame():
            pipeline.render(look_at_the_middle(angle, 0.3), buffer, clock)
    assert [frame.total_ns for frame in clock.frames] == [0, 1, 2]
    assert [frame.stages_ns["other"] for frame in clock.frames] == [0, 0, 0]


def test_what_a_renderer_that_knows_no_doubt_drew_cannot_be_refined() -> None:
    pipeline = new_pipeline()
    with pytest.raises(ValueError, match=r"pipeline\.refined: UnetRelease .* expected 0, got 0\.1"):
        Pipeline(
            pipeline.field,
            pipeline.occupancy,
            torch.ones(3),
            UnetRelease(4, 2, 4),
            replace(OPTIONS, refined=0.1),
        )


def test_a_grid_has_at_least_the_levels_that_are_read() -> None:
    for levels in (0, GRID.levels + 1):
        with pytest.raises(ValueError, match=rf"levels: expected 1 to {GRID.levels}, got {levels}"):
            new_pipeline(replace(OPTIONS, levels=levels))


def test_low_resolution_rays_read_the_coarsest_levels_alone() -> None:
    frames, reads = [], []
    for levels in (None, GRID.levels, 1):
        work = Work()
        options = replace(OPTIONS, levels=levels, surface=False)
        frames.append(new_pipeline(options).render(CAMERA, RenderingBuffer(2), work))
        reads.append(work.done["table_reads"] / work.done["samples"])
    assert torch.equal(frames[0].rgb, frames[1].rgb)
    assert not torch.equal(frames[0].rgb, frames[2].rgb)
    assert reads == [8 * GRID.levels, 8 * GRID.levels, 8]


@pytest.mark.parametrize("name", SIZES)
def test_sizes_that_make_no_frame_are_refused(name: str) -> None:
    least, most = SIZES[name]
    for wrong in (least - 1, most + 1):
        with pytest.raises(ValueError, match=f"{name}: expected {least} to {most}, got {wrong}"):
            replace(OPTIONS, **{name: wrong})


@pytest.mark.parametrize("name", ["steps", "refined_steps"])
def test_a_step_has_a_length(name: str) -> None:
    with pytest.raises(ValueError, match=f"^{name}: expected a length of more than 0, got 0.0"):
        replace(OPTIONS, **{name: 0.0})


def test_a_share_of_cells_is_between_0_and_1() -> None:
    with pytest.raises(ValueError, match=r"refined: expected a share of 0 to 1, got 1\.5"):
        replace(OPTIONS, refined=1.5)
    with pytest.raises(ValueError, match=r"overlap: expected a share of 0 to 1, got -0\.5"):
        replace(OPTIONS, overlap=-0.5)
    with pytest.raises(ValueError, match=r"stop: expected a transmittance .* got 1\.0"):
        replace(OPTIONS, stop=1.0)
    with pytest.raises(ValueError, match=r"range.mode: expected off without .* got window"):
        replace(OPTIONS, frames=0, range=RangeReduction("window"))


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
        probe, options = Work(), replace(OPTIONS, stop=0.5, skip=skips)
        new_pipeline(options).render(CAMERA, RenderingBuffer(2), probe)
        done.append(probe.done)
    assert done[1][work] > done[0][work] > 0

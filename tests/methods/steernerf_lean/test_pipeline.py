"""A frame of the lean pipeline: what is drawn, refined, dropped and skipped."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from bench.clock import StageClock
from bench.types import Camera, NullProbe
from methods.kernels.types import Occupancy
from methods.rendering.frame import everywhere, render_frame
from methods.rendering.occupancy import STEP
from methods.rendering.sampling import Sampling
from methods.steernerf.buffer import Buffer, Cloud
from methods.steernerf.options import RangeReduction
from methods.steernerf_lean import pipeline as lean
from methods.steernerf_lean.cells import cells_near, pixels_of
from methods.steernerf_lean.pipeline import worst_cells
from tests.methods.conftest import Work, look_at_the_middle
from tests.methods.models import lean_model, lean_pipeline, lean_rendering
from tests.methods.observations import shaken

USUAL = lean_rendering()
RANGED = RangeReduction("paper", 0.03, "expected")
CAMERA = look_at_the_middle(0.1, 0.3)


def test_where_every_cell_is_refined_the_picture_is_that_of_the_field() -> None:
    rendering = replace(USUAL, refined=1.0, refined_step=4.0)
    pipeline, buffer, probe = lean_pipeline(), Buffer(maxlen=1), NullProbe()
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
    assert torch.equal(buffer[0].picture, shown)  # and that is what is remembered
    remembered = Buffer(maxlen=1)
    pipeline.remember(CAMERA, remembered, rendering)
    assert torch.equal(remembered[0].picture, shown)


def test_the_cells_with_the_largest_estimated_error_are_refined() -> None:
    """A share of them, rounded up; the others stay as they were drawn."""
    share = 0.1
    pipeline, probe = lean_pipeline(), NullProbe()
    view = pipeline.view(CAMERA)
    shaken(pipeline.renderer)
    pictures = [
        pipeline.render(CAMERA, Buffer(maxlen=1), replace(USUAL, refined=part), probe).rgb
        for part in (0.0, share)
    ]
    frame = pipeline.features(view, (), USUAL, probe)
    observation = pipeline.observe(frame, (), view, USUAL, probe)
    error = pipeline.renderer([observation]).error
    order = error.sort(descending=True).indices
    count = math.ceil(share * len(order))
    before, after = (pixels_of(picture, observation.cells, 4) for picture in pictures)
    changed = (before != after).flatten(1).any(dim=1)
    assert set(worst_cells(error, share).tolist()) == set(order[:count].tolist())
    assert set(changed.nonzero().flatten().tolist()) <= set(order[:count].tolist())
    assert changed.sum() > 0.5 * count


def test_where_nothing_is_in_sight_nothing_is_refined() -> None:
    pipeline = lean_pipeline()
    pipeline.occupancy = Occupancy(torch.zeros_like(pipeline.occupancy.cells))
    frame = pipeline.render(CAMERA, Buffer(maxlen=1), replace(USUAL, refined=0.1), NullProbe())
    assert torch.equal(frame.rgb, pipeline.background[:3].expand_as(frame.rgb))


def test_a_frame_that_shows_too_little_of_the_present_view_is_as_if_forgotten() -> None:
    """After a jump to the other side."""
    here, there = look_at_the_middle(0.1, 0.3), look_at_the_middle(0.6, -0.3)
    used, pictures = {}, {}
    for overlap in (0.0, 0.5):
        rendering = replace(USUAL, overlap=overlap, range=RANGED)
        pipeline, buffer, probe = lean_pipeline(), Buffer(maxlen=1), Work()
        shaken(pipeline.renderer)
        pictures[overlap] = [
            pipeline.render(camera, buffer, rendering, probe).rgb for camera in (here, there)
        ]
        used[overlap] = probe.done["preceding_frames"]
    assert used == {0.0: 1, 0.5: 0}
    cold = pipeline.render(there, Buffer(maxlen=1), rendering, NullProbe()).rgb
    assert torch.equal(pictures[0.5][1], cold)
    assert not torch.equal(pictures[0.0][1], cold)


def test_the_time_to_see_what_frames_share_is_that_of_a_stage(monkeypatch) -> None:
    """On a clock that stands still but for this."""
    now = [0]

    def overlap(cloud: Cloud, camera: Camera) -> torch.Tensor:
        now[0] += 1
        return torch.ones(())

    monkeypatch.setattr(lean, "overlap", overlap)
    clock, buffer = StageClock("cpu", lambda: now[0]), Buffer(maxlen=1)
    pipeline, rendering = lean_pipeline(), replace(USUAL, overlap=0.5)
    for angle in (0.1, 0.2, 0.3):
        with clock.frame():
            pipeline.render(look_at_the_middle(angle, 0.3), buffer, rendering, clock)
    assert [frame.total_ns for frame in clock.frames] == [0, 1, 1]
    assert [frame.stages_ns["other"] for frame in clock.frames] == [0, 0, 0]


def test_settings_that_make_no_frame_are_refused() -> None:
    with pytest.raises(ValueError, match="frames: expected 0 to 1, got 2"):
        lean_pipeline(lean_model(frames=2))
    with pytest.raises(ValueError, match=r"refined_step: expected a length of more than 0"):
        lean_rendering(refined_step=0.0)
    with pytest.raises(ValueError, match=r"refined: expected a share of 0 to 1, got 1\.5"):
        lean_rendering(refined=1.5)
    with pytest.raises(ValueError, match=r"overlap: expected a share of 0 to 1, got -0\.5"):
        lean_rendering(overlap=-0.5)


def work(**others) -> dict[str, int]:
    """What a frame takes."""
    probe = Work()
    lean_pipeline().render(CAMERA, Buffer(maxlen=1), replace(USUAL, **others), probe)
    return probe.done


def test_cells_of_background_are_skipped_and_refinement_is_more_work_with_shorter_steps() -> None:
    usual, half = work(), work(refined=0.5)
    drawn = work(skip=replace(USUAL.skip, background=False))
    assert drawn["cells"] == 64 > usual["cells"] > 0
    longer = work(refined=0.5, refined_step=4.0)
    assert usual["samples"] < longer["samples"] < half["samples"]

"""Training sequences: what precedes a view, and how long it is used."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import torch
from methods.steernerf.training.sequences import MotionOptions, SequencePool, TrainingViews

from bench.types import Camera, Frame, NullProbe, Scene
from methods.steernerf.buffer import RenderingBuffer
from methods.steernerf.options import Rendering
from methods.training import checkpoint
from tests.methods.models import new_pipeline, small_model

TARGET = torch.full((3,), 0.5)


def new_pool(scene: Scene, motion: MotionOptions, share: float = 0.0, frames: int = 2):
    """The second half of the pictures of `scene` stands for distilled views."""
    real = TrainingViews.of(scene).real
    views = TrainingViews(real[:12], TARGET, real[12:], share)
    pipeline = new_pipeline(small_model(frames=frames))
    rendering = Rendering.in_training(pipeline.model, refined=0.0, refined_step=1.0)
    generator = torch.Generator().manual_seed(0)
    return SequencePool(pipeline, rendering, views, motion, generator)


def test_a_sequence_is_replaced_after_its_uses(ball_scene: Scene) -> None:
    pool = new_pool(ball_scene, MotionOptions(pool=1, uses=3))
    drawn = [pool.draw() for _ in range(7)]
    assert [sequence is drawn[0] for sequence in drawn] == [True] * 3 + [False] * 4
    assert drawn[3] is drawn[5]
    assert drawn[3] is not drawn[6]


def test_the_pool_holds_no_more_than_it_is_to(ball_scene: Scene) -> None:
    pool = new_pool(ball_scene, MotionOptions(pool=3, uses=100, length=1))
    assert len({id(pool.draw()) for _ in range(40)}) == 3


@pytest.mark.parametrize(("share", "distilled"), [(0.0, 0), (1.0, 20)])
def test_the_share_of_distilled_views_is_kept(
    ball_scene: Scene, share: float, distilled: int
) -> None:
    pool = new_pool(ball_scene, MotionOptions(pool=1, uses=1, length=0), share)
    of_field = {id(camera) for camera in ball_scene.splits["train"].cameras[12:]}
    drawn = [pool.draw() for _ in range(20)]
    assert sum(id(sequence.truth.camera) in of_field for sequence in drawn) == distilled


def test_cold_and_steady_starts_both_occur(ball_scene: Scene) -> None:
    pool = new_pool(ball_scene, MotionOptions(pool=1, uses=1, length=3))
    lengths = {len(pool.draw().buffer.frames) for _ in range(24)}
    assert lengths == {0, 1, 2}  # L = 2 of the 0 to 3 that were rendered


def test_a_view_can_always_have_all_its_preceding_frames(ball_scene: Scene) -> None:
    pool = new_pool(ball_scene, MotionOptions(pool=1, uses=1, length=2, least=2))
    assert {len(pool.draw().buffer.frames) for _ in range(12)} == {2}


@pytest.mark.parametrize("history", [False, True])
def test_a_preceding_frame_is_drawn_only_if_its_picture_is_read(
    ball_scene: Scene, history: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its features and depth are the same either way."""
    pipeline = new_pipeline(small_model(history=history, surface=False))
    camera, drawn = ball_scene.splits["train"].cameras[0], []
    forward = pipeline.renderer.forward
    monkeypatch.setattr(
        pipeline.renderer, "forward", lambda *given: (drawn.append(given), forward(*given))[1]
    )
    rendering = Rendering.in_training(pipeline.model, refined=0.0, refined_step=1.0)
    remembered, rendered = RenderingBuffer(2), RenderingBuffer(2)
    pipeline.remember(camera, remembered, rendering)
    assert len(drawn) == int(history)
    pipeline.render(camera, rendered, rendering, NullProbe())
    one, other = (buffer.frames[0] for buffer in (remembered, rendered))
    assert torch.equal(one.cloud.values, other.cloud.values)
    assert torch.equal(one.cloud.points, other.cloud.points)
    assert (one.picture is None) == (other.picture is None) == (not history)


def test_the_newest_preceding_frame_is_a_step_away(ball_scene: Scene) -> None:
    motion = MotionOptions(degrees=(2.0, 2.0), pool=1, uses=1, length=3, longer=0.0)
    pool = new_pool(ball_scene, motion)
    for sequence in (pool.draw() for _ in range(12)):
        away = sequence.truth.camera.c2w[:, 3] - TARGET
        for age, frame in enumerate(sequence.buffer.frames, 1):
            then = frame.camera.c2w[:, 3] - TARGET
            turn = torch.rad2deg(torch.acos(torch.cosine_similarity(away, then, dim=0)))
            assert turn.item() == pytest.approx(2.0 * age, rel=0.05)  # the bend makes it shorter


def test_a_sequence_goes_on_there_and_back_to_its_view(
    ball_scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    motion = MotionOptions(degrees=(2.0, 2.0), pool=1, uses=1, length=4, longer=0.999)
    pool = new_pool(ball_scene, motion)
    drawn, rendered = [pool.draw()], []
    render = pool.pipeline.render

    def watched(camera: Camera, *rest: Any) -> Frame:
        rendered[-1].append(camera)
        return render(camera, *rest)

    monkeypatch.setattr(pool.pipeline, "render", watched)
    for _ in range(11):
        rendered.append([])
        drawn.append(pool.draw())
    assert len({id(sequence.truth) for sequence in drawn}) == 1
    centre = drawn[0].truth.camera.c2w[:, 3]
    for done, after in zip(rendered, drawn[1:], strict=True):
        frames = len(done)
        assert frames in (1, 2, 4)  # the view, and if the camera leaves it, out and back
        moved = (after.buffer.frames[0].camera.c2w[:, 3] - centre).norm().item()
        step = 2 * (centre - TARGET).norm().item() * math.sin(math.radians(1.0))
        assert moved == pytest.approx(0.0 if frames == 1 else step, rel=0.02, abs=1e-6)


def test_going_on_leaves_what_was_drawn_before_as_it_was(ball_scene: Scene) -> None:
    pool = new_pool(ball_scene, MotionOptions(pool=1, uses=1, length=3, longer=0.999))
    first = pool.draw()
    frames = first.buffer.frames
    pool.draw()
    assert first.buffer.frames == frames


def test_a_pool_that_was_kept_in_a_file_goes_on_as_it_would_have(
    ball_scene: Scene, tmp_path: Path
) -> None:
    motion = MotionOptions(pool=3, uses=2, longer=0.5)
    pool, other = (new_pool(ball_scene, motion, share=0.5) for _ in range(2))
    for _ in range(12):
        pool.draw()
    checkpoint.write(tmp_path / "pool.safetensors", pool.state(), {})
    other.restore(checkpoint.read(tmp_path / "pool.safetensors")[0])
    other._generator.set_state(pool._generator.get_state())
    for _ in range(12):
        one, same = pool.draw(), other.draw()
        assert torch.equal(one.truth.picture, same.truth.picture)
        assert torch.equal(one.cells, same.cells)
        assert (one.uses, one.lasting) == (same.uses, same.lasting)
        kept, found = one.buffer.state(), same.buffer.state()
        assert kept.keys() == found.keys()
        assert all(torch.equal(kept[name], found[name]) for name in kept)
        for a, b in zip(one.buffer.frames, same.buffer.frames, strict=True):
            assert torch.equal(a.picture, b.picture)


def test_cells_are_those_in_which_something_is(ball_scene: Scene) -> None:
    sequence = new_pool(ball_scene, MotionOptions(pool=1, uses=1), frames=0).draw()
    alpha = sequence.truth.picture[..., 3].float().view(8, 4, 8, 4).amax(dim=(1, 3))
    assert torch.equal(sequence.cells, (alpha > 0).nonzero())

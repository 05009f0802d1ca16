"""Training examples: what precedes a view, and how long it is used."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from bench.types import Camera, Scene
from methods.steernerf.training.examples import ExamplePool, TrainingViews
from methods.steernerf.training.options import MotionOptions
from methods.training import checkpoint
from tests.methods.models import (
    lean_pipeline,
    lean_rendering,
    new_pipeline,
    small_model,
    small_motion,
    small_rendering,
)

TARGET = torch.full((3,), 0.5)


def new_pool(
    scene: Scene, motion: MotionOptions, share: float = 0.0, frames: int = 2, lean: bool = False
) -> ExamplePool:
    """The second half of the pictures of `scene` stands for distilled views."""
    views = replace(TrainingViews.of(scene), real=12, share=share, target=TARGET)
    pipeline = lean_pipeline() if lean else new_pipeline(small_model(frames=frames))
    rendering = lean_rendering() if lean else small_rendering()
    generator = torch.Generator().manual_seed(0)
    return ExamplePool(pipeline, rendering, views, motion, generator)


def test_an_example_is_replaced_after_its_uses(ball_scene: Scene) -> None:
    pool = new_pool(ball_scene, small_motion(pool=1, uses=3))
    drawn = [pool.draw() for _ in range(7)]
    assert [example is drawn[0] for example in drawn] == [True] * 3 + [False] * 4
    assert drawn[3] is drawn[5]
    assert drawn[3] is not drawn[6]


def test_the_pool_holds_no_more_than_it_is_to(ball_scene: Scene) -> None:
    pool = new_pool(ball_scene, small_motion(pool=3, uses=100, length=1))
    assert len({id(pool.draw()) for _ in range(40)}) == 3


@pytest.mark.parametrize(("share", "distilled"), [(0.0, 0), (1.0, 20)])
def test_the_share_of_distilled_views_is_kept(
    ball_scene: Scene, share: float, distilled: int
) -> None:
    pool = new_pool(ball_scene, small_motion(pool=1, uses=1, length=0), share)
    drawn = [pool.draw() for _ in range(20)]
    assert sum(example.number >= 12 for example in drawn) == distilled


def test_cold_and_steady_starts_both_occur(ball_scene: Scene) -> None:
    pool = new_pool(ball_scene, small_motion(pool=1, uses=1, length=3))
    lengths = {len(pool.draw().buffer) for _ in range(24)}
    assert lengths == {0, 1, 2}  # L = 2 of the 0 to 3 that were rendered


def test_a_view_can_always_have_all_its_preceding_frames(ball_scene: Scene) -> None:
    pool = new_pool(ball_scene, small_motion(pool=1, uses=1, length=2, least=2))
    assert {len(pool.draw().buffer) for _ in range(12)} == {2}


def test_the_newest_preceding_frame_is_a_step_away(ball_scene: Scene) -> None:
    motion = small_motion(degrees=(2.0, 2.0), pool=1, uses=1, length=3, longer=0.0)
    pool = new_pool(ball_scene, motion)
    for example in (pool.draw() for _ in range(12)):
        away = pool.views.cameras[example.number].c2w[:, 3] - TARGET
        for age, cloud in enumerate(example.buffer, 1):
            then = cloud.camera.c2w[:, 3] - TARGET
            turn = torch.rad2deg(torch.acos(torch.cosine_similarity(away, then, dim=0)))
            assert turn.item() == pytest.approx(2.0 * age, rel=0.05)  # the bend makes it shorter


def test_an_example_goes_on_there_and_back_to_its_view(
    ball_scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    motion = small_motion(degrees=(2.0, 2.0), pool=1, uses=1, length=4, longer=0.999)
    pool = new_pool(ball_scene, motion)
    drawn, rendered = [pool.draw()], []
    remember = pool.pipeline.remember

    def watched(camera: Camera, *rest: Any) -> None:
        rendered[-1].append(camera)
        remember(camera, *rest)

    monkeypatch.setattr(pool.pipeline, "remember", watched)
    for _ in range(11):
        rendered.append([])
        drawn.append(pool.draw())
    assert len({example.number for example in drawn}) == 1
    centre = pool.views.cameras[drawn[0].number].c2w[:, 3]
    for done, after in zip(rendered, drawn[1:], strict=True):
        frames = len(done)
        assert frames in (1, 2, 4)  # the view, and if the camera leaves it, out and back
        moved = (after.buffer[0].camera.c2w[:, 3] - centre).norm().item()
        step = 2 * (centre - TARGET).norm().item() * math.sin(math.radians(1.0))
        assert moved == pytest.approx(0.0 if frames == 1 else step, rel=0.02, abs=1e-6)


def test_going_on_leaves_what_was_drawn_before_as_it_was(ball_scene: Scene) -> None:
    pool = new_pool(ball_scene, small_motion(pool=1, uses=1, length=3, longer=0.999))
    first = pool.draw()
    before = list(first.buffer)
    pool.draw()
    assert list(first.buffer) == before


@pytest.mark.parametrize("lean", [False, True])
def test_a_pool_that_was_kept_in_a_file_goes_on_as_it_would_have(
    ball_scene: Scene, tmp_path: Path, lean: bool
) -> None:
    motion = small_motion(pool=3, uses=2, longer=0.5)
    pool, other = (new_pool(ball_scene, motion, share=0.5, lean=lean) for _ in range(2))
    for _ in range(12):
        pool.draw()
    checkpoint.write(tmp_path / "pool.safetensors", pool.state(), {})
    other.restore(checkpoint.read(tmp_path / "pool.safetensors")[0])
    other._generator.set_state(pool._generator.get_state())
    for _ in range(12):
        one, same = pool.draw(), other.draw()
        assert (one.number, one.uses, one.lasting) == (same.number, same.uses, same.lasting)
    kept, found = pool.state(), other.state()
    assert kept.keys() == found.keys()
    assert all(torch.equal(kept[name], found[name]) for name in kept)
    assert any(name.endswith(".picture") for name in kept) == lean

"""Distilled views: as a field shows them, rendered once, found again."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from bench.cameras import pack_camera
from bench.console import ConsoleLog
from bench.types import Budget, NullProbe, Scene
from methods.instant_ngp.stage1 import Setup, TrainedField
from methods.rendering.frame import everywhere, render_frame
from methods.steernerf.training import distillation
from methods.steernerf.training.distillation import distilled_views
from methods.steernerf.training.sequences import TrueView
from tests.methods.conftest import SIZE
from tests.methods.models import SMALL_GRID, misty_field, trained_field
from tests.methods.trainings import QUICK

COUNT = 3
BUDGET = Budget("test", steps=1, samples=1)


@pytest.fixture(scope="module")
def trained() -> TrainedField:
    """In place of a trained field, one in which there is something to see."""
    return trained_field(misty_field(channels=3))


def views_of(
    trained: TrainedField, scene: Scene, root: Path, seed: int = 0, count: int = COUNT
) -> list[TrueView]:
    """With `root` as the folder of all results."""
    setup = Setup.resolved(SMALL_GRID, QUICK, "bf16", "auto", "cpu", seed)
    log = ConsoleLog(root, quiet=True)
    return distilled_views(setup, trained, scene, BUDGET, count, log)[0]


def same(first: list[TrueView], second: list[TrueView]) -> bool:
    """Whether poses, intrinsics and pictures are equal to the last bit."""
    return all(
        torch.equal(pack_camera(a.camera), pack_camera(b.camera))
        and torch.equal(a.picture, b.picture)
        for a, b in zip(first, second, strict=True)
    )


def test_a_view_is_what_the_field_shows_at_full_resolution(
    trained: TrainedField, ball_scene: Scene, tmp_path: Path
) -> None:
    views = views_of(trained, ball_scene, tmp_path)
    assert len(views) == COUNT
    for view in views:
        assert (view.camera.width, view.camera.height) == (SIZE, SIZE)
        assert view.picture.shape == (SIZE, SIZE, 3)
        assert view.picture.dtype == torch.uint8
        field, occupancy, probe = trained.field, trained.occupancy, NullProbe()
        render = everywhere(field, occupancy, probe, trained.sampling)
        white = ball_scene.background
        frame = render_frame(view.camera, occupancy, white, probe, render)
        assert (frame.alpha > 0.1).float().mean() > 0.1
        shown = 255 * frame.values
        assert (view.picture.float() - shown).abs().max() <= 0.5 + 1e-4  # rounded, in float32


def test_views_lie_among_the_training_cameras_and_on_none(
    trained: TrainedField, ball_scene: Scene, tmp_path: Path
) -> None:
    centres = torch.stack([camera.c2w[:, 3] for camera in ball_scene.splits["train"].cameras])
    for view in views_of(trained, ball_scene, tmp_path):
        away = (view.camera.c2w[:, 3] - centres).norm(dim=1)
        assert 1e-3 < away.min() < 1.6  # the distance of all cameras from the ball


def test_views_are_found_again_without_rendering(
    trained: TrainedField,
    ball_scene: Scene,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    first = views_of(trained, ball_scene, tmp_path)
    monkeypatch.delattr(distillation, "render_frame")
    assert same(views_of(trained, ball_scene, tmp_path), first)
    with pytest.raises(NameError, match="render_frame"):
        views_of(trained, ball_scene, tmp_path / "elsewhere")
    left = (tmp_path / "elsewhere" / "stages").glob("*/*")
    assert [path.name for path in left] == ["lock"]


def test_other_numbers_of_views_are_others(
    trained: TrainedField, ball_scene: Scene, tmp_path: Path
) -> None:
    assert views_of(trained, ball_scene, tmp_path, count=0) == []
    assert len(views_of(trained, ball_scene, tmp_path, count=1)) == 1
    assert len(views_of(trained, ball_scene, tmp_path, count=2)) == 2


def test_the_seed_alone_decides_which_views(
    trained: TrainedField, ball_scene: Scene, tmp_path: Path
) -> None:
    first, again, other = (
        views_of(trained, ball_scene, tmp_path / name, seed)
        for name, seed in (("first", 0), ("again", 0), ("other", 1))
    )
    assert same(first, again)
    assert not any(
        torch.equal(a.camera.c2w, b.camera.c2w) for a, b in zip(first, other, strict=True)
    )

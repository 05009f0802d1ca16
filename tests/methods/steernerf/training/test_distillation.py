"""Views that nobody photographed, as a field shows them: rendered once, found again."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from methods.steernerf.method.training import distillation as distil
from tests.methods.test_joint import TARGET, misty_field, shell

from bench.cameras import pack_camera
from bench.types import Log, NullProbe, Scene
from methods.instant_ngp.stage1 import Pretrained
from methods.steernerf.range_reduction import render_guided
from methods.steernerf.training.distillation import distilled_views
from methods.steernerf.training.sequences import TrueView
from tests.methods.conftest import SIZE

COUNT = 3


@pytest.fixture(scope="module")
def trained() -> Pretrained:
    """In place of a trained field, one in which there is something to see."""
    return Pretrained(misty_field(channels=3), shell(), train_s=0.0)


def views_of(
    trained: Pretrained, scene: Scene, folder: Path, log: Log, seed: int = 0
) -> list[TrueView]:
    folder.mkdir(exist_ok=True)
    return distilled_views(trained, scene, TARGET, COUNT, seed, folder, log)[0]


def same(first: list[TrueView], second: list[TrueView]) -> bool:
    """Whether poses, intrinsics and pictures are equal to the last bit."""
    return all(
        torch.equal(pack_camera(a.camera), pack_camera(b.camera))
        and torch.equal(a.picture, b.picture)
        for a, b in zip(first, second, strict=True)
    )


def test_a_view_is_what_the_field_shows_at_full_resolution(
    trained: Pretrained, ball_scene: Scene, tmp_path: Path, quiet_log: Log
) -> None:
    views = views_of(trained, ball_scene, tmp_path, quiet_log)
    assert len(views) == COUNT
    for view in views:
        assert (view.camera.width, view.camera.height) == (SIZE, SIZE)
        assert view.picture.shape == (SIZE, SIZE, 3)
        assert view.picture.dtype == torch.uint8
        frame = render_guided(
            trained.field,
            view.camera,
            trained.occupancy,
            ball_scene.background,
            NullProbe(),
            None,
        )
        assert (frame.alpha > 0.1).float().mean() > 0.1
        shown = 255 * frame.values
        assert (view.picture.float() - shown).abs().max() <= 0.5 + 1e-4  # rounded, in float32


def test_views_lie_among_the_training_cameras_and_on_none(
    trained: Pretrained, ball_scene: Scene, tmp_path: Path, quiet_log: Log
) -> None:
    centres = torch.stack([camera.c2w[:, 3] for camera in ball_scene.splits["train"].cameras])
    for view in views_of(trained, ball_scene, tmp_path, quiet_log):
        away = (view.camera.c2w[:, 3] - centres).norm(dim=1)
        assert 1e-3 < away.min() < 1.6  # the distance of all cameras from the ball


def test_views_are_found_again_without_rendering(
    trained: Pretrained,
    ball_scene: Scene,
    tmp_path: Path,
    quiet_log: Log,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    first = views_of(trained, ball_scene, tmp_path, quiet_log)
    monkeypatch.delattr(distil, "render_guided")
    assert same(views_of(trained, ball_scene, tmp_path, quiet_log), first)
    with pytest.raises(NameError, match="render_guided"):
        views_of(trained, ball_scene, tmp_path / "elsewhere", quiet_log)
    assert [path.name for path in (tmp_path / "elsewhere").iterdir()] == ["lock"]


def test_the_seed_alone_decides_which_views(
    trained: Pretrained, ball_scene: Scene, tmp_path: Path, quiet_log: Log
) -> None:
    first, again, other = (
        views_of(trained, ball_scene, tmp_path / name, quiet_log, seed)
        for name, seed in (("first", 0), ("again", 0), ("other", 1))
    )
    assert same(first, again)
    assert not any(
        torch.equal(a.camera.c2w, b.camera.c2w) for a, b in zip(first, other, strict=True)
    )

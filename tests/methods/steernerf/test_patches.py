"""What stage 2 learns from: distilled views, examples and how long they are used, patches."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from bench.cameras import crop_camera, pack_camera
from bench.console import ConsoleLog
from bench.types import Budget, NullProbe, Scene, Split
from methods.instant_ngp.stage1 import Setup, TrainedField
from methods.rendering.frame import everywhere, render_frame
from methods.steernerf import distillation
from methods.steernerf.distillation import distilled_views
from methods.steernerf.options import MotionOptions
from methods.steernerf.patches import Patches
from tests.common import refusal, seeded
from tests.methods.conftest import SIZE, ball
from tests.methods.models import (
    SMALL_GRID,
    misty_field,
    new_pipeline,
    small_joint,
    small_motion,
    trained_field,
)
from tests.methods.trainings import QUICK

COUNT = 3
BUDGET = Budget("test", steps=1, samples=1)
TARGET = torch.full((3,), 0.5)


@pytest.fixture(scope="module")
def trained() -> TrainedField:
    """In place of a trained field, one in which there is something to see."""
    return trained_field(misty_field(channels=3))


def views_of(
    trained: TrainedField, scene: Scene, root: Path, seed: int = 0, count: int = COUNT
) -> Split:
    """Distilled views, with `root` as the folder of all results."""
    setup = Setup.resolved(SMALL_GRID, QUICK, "bf16", "auto", "cpu", seed)
    log = ConsoleLog(root, quiet=True)
    return distilled_views(setup, trained, scene, BUDGET, count, log)[0]


def same(first: Split, second: Split) -> bool:
    """Whether poses, intrinsics and pictures are equal to the last bit."""
    pairs = zip(*([*map(pack_camera, x.cameras), *x.images] for x in (first, second)), strict=True)
    return all(torch.equal(*pair) for pair in pairs)


def test_a_distilled_view_is_what_the_field_shows_among_the_training_cameras(
    trained, ball_scene, tmp_path
):
    """At full resolution, and on none of them."""
    centres = torch.stack([camera.c2w[:, 3] for camera in ball_scene.splits["train"].cameras])
    views = views_of(trained, ball_scene, tmp_path)
    assert len(views) == COUNT
    for camera, picture in zip(views.cameras, views.images, strict=True):
        assert (camera.width, camera.height) == (SIZE, SIZE)
        assert picture.shape == (SIZE, SIZE, 3)
        assert picture.dtype == torch.uint8
        away = (camera.c2w[:, 3] - centres).norm(dim=1)
        assert 1e-3 < away.min() < 1.6  # the distance of all cameras from the ball
        field, occupancy, probe = trained.field, trained.occupancy, NullProbe()
        render = everywhere(field, occupancy, probe, trained.sampling)
        frame = render_frame(camera, occupancy, ball_scene.background, probe, render)
        assert (frame.alpha > 0.1).float().mean() > 0.1
        shown = 255 * frame.values
        assert (picture.float() - shown).abs().max() <= 0.5 + 1e-4  # rounded, in float32


def test_distilled_views_are_found_again_without_rendering(
    trained, ball_scene, tmp_path, monkeypatch
):
    first = views_of(trained, ball_scene, tmp_path)
    assert views_of(trained, ball_scene, tmp_path, count=0).cameras == []
    assert len(views_of(trained, ball_scene, tmp_path, count=1)) == 1  # other views
    monkeypatch.delattr(distillation, "render_frame")
    assert same(views_of(trained, ball_scene, tmp_path), first)
    with refusal("render_frame", NameError):
        views_of(trained, ball_scene, tmp_path / "elsewhere")
    left = (tmp_path / "elsewhere/stages").glob("*/*")
    assert [path.name for path in left] == ["lock"]
    # The seed alone decides which they are.
    monkeypatch.undo()
    assert same(views_of(trained, ball_scene, tmp_path / "again"), first)
    other = views_of(trained, ball_scene, tmp_path, seed=1)
    pairs = zip(first.cameras, other.cameras, strict=True)
    assert not any(torch.equal(a.c2w, b.c2w) for a, b in pairs)


def new_patches(
    scene: Scene, motion: MotionOptions, share: float = 0.0, frames: int = 2, **joint: Any
) -> Patches:
    """The second half of the pictures of `scene` stands for distilled views."""
    split = scene.splits["train"]
    halves = [
        replace(split, cameras=split.cameras[part], images=split.images[part], names=())
        for part in (slice(12), slice(12, None))
    ]
    scene = replace(scene, splits={"train": halves[0]})
    options = small_joint(distilled_share=share, motion=motion, **joint)
    pipeline, generator = new_pipeline(frames=frames), seeded(0)
    return Patches(pipeline, scene, halves[1], options, generator)


def test_an_example_is_replaced_after_its_uses(ball_scene):
    source = new_patches(ball_scene, small_motion(pool=1, uses=3))
    drawn = [source.example() for _ in range(7)]
    assert [example is drawn[0] for example in drawn] == [True] * 3 + [False] * 4
    assert drawn[3] is drawn[5]
    assert drawn[3] is not drawn[6]


def test_the_pool_holds_no_more_than_it_is_to(ball_scene):
    source = new_patches(ball_scene, small_motion(pool=3, uses=100))
    assert len({id(source.example()) for _ in range(40)}) == 3


@pytest.mark.parametrize("share", [0, 1])
def test_the_share_of_distilled_views_is_kept(ball_scene, share):
    source = new_patches(ball_scene, small_motion(pool=1, uses=1), share, frames=0)
    assert all((source.example().number >= 12) == share for _ in range(20))


def test_the_newest_preceding_frame_is_a_step_away(ball_scene):
    motion = small_motion(degrees=(2.0, 2.0), pool=1, uses=1)
    source = new_patches(ball_scene, motion)
    for example in (source.example() for _ in range(12)):
        assert len(example.buffer) == 2
        away = source.cameras[example.number].c2w[:, 3] - TARGET
        for age, cloud in enumerate(example.buffer, 1):
            then = cloud.camera.c2w[:, 3] - TARGET
            turn = torch.rad2deg(torch.acos(torch.cosine_similarity(away, then, dim=0)))
            assert turn.item() == pytest.approx(2.0 * age, rel=0.05)  # the bend makes it shorter


MOTION = small_motion(pool=3, uses=100)


def test_patches_of_pictures_of_several_sizes_have_one_side(ball_scene):
    """The shortest side of all, if patches are longer: 24 pixels are 6 low-resolution pixels."""
    split = ball_scene.splits["train"]
    narrow = crop_camera(split.cameras[0], 4, 0, SIZE - 8, SIZE)
    cameras = [narrow, *split.cameras[1:]]
    images = [split.images[0][:, 4:-4], *split.images[1:]]
    scene = replace(ball_scene, splits={"train": replace(split, cameras=cameras, images=images)})
    source = new_patches(scene, small_motion(uses=1), patch=8)
    cuts = [source.cut(source.example()) for _ in range(60)]
    assert {0, 1} <= {cut.example.number for cut in cuts}
    assert {cut.truth.shape for cut in cuts} == {(24, 24, 3)}


def test_a_patch_lies_anywhere(ball_scene):
    """Of a side of 2: the corner of a picture shows background alone."""
    source = new_patches(ball_scene, MOTION, patch=2)
    cuts = [source.cut(source.example()) for _ in range(200)]
    corners = {(round(patch.view.low.cx, 3), round(patch.view.low.cy, 3)) for patch in cuts}
    assert len(corners) > 40  # of 7 x 7, one of which 200 draws miss in the mean
    assert any((patch.truth == 1).all() for patch in cuts)


def test_rays_of_patches_are_jittered_if_they_are_to(ball_scene):
    """The same patch twice: other samples, and so other opacities, only with jitter."""
    for jitter in (False, True):
        source = new_patches(ball_scene, MOTION, patch=4, jitter=jitter)
        patch = source.cut(source.example())
        one, other = (source.render([patch]).opacity for _ in range(2))
        assert torch.equal(one, other) == (not jitter)


def test_a_patch_shows_what_the_picture_shows_there(ball_scene):
    """The true colour of a pixel of the ball is its normal: also that of the patch's own camera."""
    source = new_patches(ball_scene, MOTION, patch=4)
    patch = source.cut(source.example())
    cut = patch.view.full
    assert patch.truth.shape == (16, 16, 3)  # of 4 x 4 low-resolution pixels
    expected = ball(cut).float() / 255
    expected = expected[..., :3] * expected[..., 3:] + 1 - expected[..., 3:]
    assert (patch.truth - expected).abs().max() <= 1 / 255  # the colour of a ray, rounded twice


def test_beyond_the_border_of_a_picture_its_last_row_and_column_go_on(ball_scene):
    """Of a picture of 18 x 19 pixels, cut through the ball, the last cells are not all there."""
    split = ball_scene.splits["train"]
    cameras = [replace(camera, width=18, height=19) for camera in split.cameras]
    images = [image[:19, :18] for image in split.images]
    scene = replace(ball_scene, splits={"train": replace(split, cameras=cameras, images=images)})
    truth = new_patches(scene, MOTION, patch=SIZE).draw(1).truth[0]
    assert truth.shape == (20, 20, 3)
    assert truth[:, 17].std() > 0  # not of background alone
    assert torch.equal(truth[:, 18:], truth[:, 17:18].expand(-1, 2, -1))
    assert torch.equal(truth[19], truth[18])

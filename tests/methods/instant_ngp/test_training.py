"""The training loop: what it learns, that it repeats, goes on after a kill, and stops on NaN."""

from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
import torch

from bench.console import ConsoleLog
from bench.types import Budget, Scene, Split, Unavailable, composite
from methods.instant_ngp.cases import cases
from methods.instant_ngp.field import HashField
from methods.instant_ngp.pixels import RUN, UNSEEN
from methods.instant_ngp.stage1 import train_field
from methods.instant_ngp.training import MIN_RAYS, FieldTraining, PixelTraining
from methods.kernels.types import Pixels
from methods.rendering.occupancy import RESOLUTION, STEP
from methods.training import checkpoint, loop
from tests.common import refusal, seeded
from tests.methods.trainings import (
    GRID,
    QUICK,
    TEACHER,
    does_not_see_what_masks_hide,
    killed,
)
from tests.methods.usual import field_options

BUDGET = Budget("test", steps=40, samples=1024)


def new_training(scene: Scene, **options: Any) -> FieldTraining:
    field = HashField(GRID, generator=seeded(0))
    return FieldTraining(field, scene, BUDGET, replace(QUICK, **options), seed=0)


def trained(scene: Scene, root: Path) -> HashField:
    """The field that is trained with `root` as the folder of all results."""
    return train_field(TEACHER, scene, BUDGET, ConsoleLog(root, quiet=True)).field


def stage(scene: Scene, root: Path) -> Path:
    """Where that field is kept."""
    return ConsoleLog(root, quiet=True).stage_dir("field", TEACHER.key(scene, BUDGET))


@pytest.fixture
def unlit(ball_scene, monkeypatch) -> FieldTraining:
    """A training that renders every pixel black and learns nothing."""

    def render(rays, jitter, background):
        black = Pixels.blank(len(jitter), 3)
        return replace(black, values=black.values.requires_grad_()), BUDGET.samples

    training = new_training(ball_scene, random_background=False)
    training.step = 1  # the density grid is not visited, which would draw random numbers
    monkeypatch.setattr(training, "_render", render)
    monkeypatch.setattr(training, "_update", lambda: None)
    return training


def test_masked_pixels_are_not_learnt_from(ball_scene):
    does_not_see_what_masks_hide(new_training, ball_scene)


def test_the_error_shown_is_that_of_pixels_drawn_alike(unlit):
    generator = unlit.generator.clone_state()
    _, colours = unlit.batches.at(unlit.batches.choose(unlit.rays // 2, generator))
    wrong = unlit.errors.draw(unlit.rays // 2, generator)
    shown = unlit.advance()[""]
    truth = composite((255 * colours).round().byte(), unlit.background)
    assert shown == pytest.approx(truth.square().mean().item())
    assert (unlit.errors.errors[wrong // RUN] != UNSEEN).all()


def test_an_error_that_is_not_finite_stops_it(unlit):
    dark = unlit._render

    def render(rays, jitter, background):
        pixels, samples = dark(rays, jitter, background)
        last = torch.zeros(len(jitter), 1)
        last[-1] = torch.nan
        return replace(pixels, values=pixels.values + last), samples

    unlit._render = render
    with refusal("rendered pixels"):
        unlit.advance()


def test_the_batch_grows_to_its_share_of_the_samples(ball_scene):
    training = new_training(ball_scene, share=0.25)
    training.rays = 100
    for wanted in (50, 50, 50):  # each ray brought half a sample: the batch may grow by a quarter
        training._fit_batch(wanted)
    assert training.rays == int(int(125 * 1.25) * 1.25) == 195
    training._fit_batch(BUDGET.samples // 4 * 5 // 4)
    assert training.rays == 195 * 4 // 5


def test_the_learning_rate_falls_from_the_first_to_the_last_step(ball_scene):
    training, rates = new_training(ball_scene), []
    for training.step in range(BUDGET.steps + 1):
        rates.append(training.learning_rate())
    assert rates == sorted(rates, reverse=True)
    assert (rates[0], rates[-1]) == pytest.approx((1e-2, 1e-2 / 30))


def test_the_step_of_the_rays_suits_the_length_of_the_training_or_is_given():
    def step(steps, march_step=None):
        return field_options(march_step=march_step).sampling(replace(BUDGET, steps=steps)).step

    assert step(20_000) == STEP  # as long as the release trains
    assert step(1000) / step(8000) == pytest.approx(2)
    assert step(1) == 1 / RESOLUTION  # no longer than a cell
    assert step(1, march_step=3.0) == step(20_000, march_step=3.0) == 3 * STEP


def test_a_killed_training_ends_as_if_it_had_never_stopped_and_is_then_loaded(
    ball_scene, tmp_path, monkeypatch
):
    whole, root = trained(ball_scene, tmp_path / "whole"), tmp_path / "killed"
    with killed(FieldTraining, 23):
        trained(ball_scene, root)
    folder = stage(ball_scene, root)
    assert {path.name for path in folder.iterdir()} == {"checkpoint.safetensors", "lock"}
    resumed = trained(ball_scene, root)
    assert {path.name for path in folder.iterdir()} == {"field.safetensors", "lock"}
    written = (folder / "field.safetensors").stat().st_mtime_ns
    monkeypatch.delattr(PixelTraining, "advance")
    for field in (resumed, trained(ball_scene, root)):
        assert torch.equal(field.table, whole.table)
        assert torch.equal(field.packed, whole.packed)
        assert all(torch.equal(field.layers[name], x) for name, x in whole.layers.items())
    assert (folder / "field.safetensors").stat().st_mtime_ns == written


def test_a_loss_that_is_no_number_stops_and_keeps_the_last_good_checkpoint(
    ball_scene, tmp_path, monkeypatch
):
    monkeypatch.setattr(loop, "CHECKPOINT_S", -1.0)
    advance = FieldTraining.advance

    def spoiled_at_10(training):
        if training.step == 10:
            with torch.no_grad():
                training.field.layers["feature_mid"][0, 0] = torch.nan
        return advance(training)

    monkeypatch.setattr(FieldTraining, "advance", spoiled_at_10)
    with refusal(r"step 10.*feature_mid.*last good checkpoint"):
        trained(ball_scene, tmp_path)
    training = new_training(ball_scene)
    loop.load(training, stage(ball_scene, tmp_path) / "checkpoint.safetensors")
    assert training.step == 10
    assert all(layer.isfinite().all() for layer in training.field.layers.values())


def test_a_training_that_went_bad_in_its_last_step_is_not_finished(
    ball_scene, tmp_path, monkeypatch
):
    update = FieldTraining._update

    def spoiled(training):
        update(training)
        if training.step == BUDGET.steps - 1:
            with torch.no_grad():
                training.field.table[0, 0] = torch.inf

    monkeypatch.setattr(FieldTraining, "_update", spoiled)
    with refusal(r"step 40: not finite: table"):
        trained(ball_scene, tmp_path)
    assert [path.name for path in stage(ball_scene, tmp_path).iterdir()] == ["lock"]


@pytest.mark.parametrize("name", ["field", "checkpoint"])
def test_a_file_that_is_damaged_or_of_another_training_is_named_with_what_to_do(
    ball_scene, tmp_path, name
):
    path = stage(ball_scene, tmp_path) / f"{name}.safetensors"
    path.write_bytes(b"half a file")
    with refusal(rf"{name}\.safetensors.*remove it, and it is made"):
        trained(ball_scene, tmp_path)
    checkpoint.write(path, {"mean.weight": torch.zeros(3)}, {})
    whole = path.read_bytes()
    path.write_bytes(whole[:-1] + b"1")  # one weight is another number
    with refusal(rf"{name}\.safetensors.*its checksum is wrong"):
        trained(ball_scene, tmp_path)
    path.write_bytes(whole)
    message = rf"{name}\.safetensors: expected the file of this .*; remove it to train again"
    with refusal(message):
        trained(ball_scene, tmp_path)


@pytest.mark.parametrize("setting", ["max_rays", "rays"])
def test_a_step_has_the_rays_that_were_asked_for(setting, ball_scene):
    """Though 64 rays bring far fewer samples than the budget."""
    training = new_training(ball_scene, **{setting: MIN_RAYS})
    for _ in range(3):
        assert training.rays == MIN_RAYS
        training.advance()


def test_pictures_that_do_not_overlap_are_refused(ball_scene):
    train = ball_scene.splits["train"]
    alone = Split(train.cameras[:1], train.images[:1], train.names[:1])
    with refusal("no part of the unit cube is seen by 2 training"):
        new_training(replace(ball_scene, splits={"train": alone}))


def test_a_checkpoint_that_cannot_be_written_says_so(tmp_path):
    with refusal(r"gone.*cannot write the checkpoint"):
        checkpoint.write(tmp_path / "gone/field.safetensors", {}, {})


def test_a_random_background_is_one_colour_for_a_ray_and_its_truth(ball_scene):
    training = new_training(ball_scene)
    clear = torch.cat((torch.rand(9, 3), torch.zeros(9, 1)), dim=1)
    target, background = training._target(clear)
    assert torch.equal(target, background)
    assert len(set(map(tuple, background.tolist()))) == 9
    target, _ = training._target(torch.cat((clear[:, :3], torch.ones(9, 1)), dim=1))
    assert torch.equal(target, clear[:, :3])


@pytest.mark.parametrize(("space", "backgrounds"), [("box", 1), ("all", 9)])
def test_opaque_colours_stay_and_where_space_has_no_end_hide_a_random_background(
    space, backgrounds, ball_scene
):
    training = new_training(replace(ball_scene, space=space))
    colours = torch.rand(9, 3)
    target, background = training._target(colours)
    assert torch.equal(target, colours)
    assert len(set(map(tuple, background.expand(9, 3).tolist()))) == backgrounds


STRESS = [case for case in cases() if case.subject == "training"]


@pytest.mark.parametrize("case", STRESS, ids=lambda case: case.name)
def test_in_a_stress_case_what_is_not_there_is_no_answer(case, monkeypatch):
    cause = Unavailable("not on this machine")
    monkeypatch.setattr(HashField, "density", Mock(side_effect=cause))
    row = case.check(next(iter(case.tolerances)), "cpu")
    assert row["status"] == "unavailable: not on this machine"

"""Instant-NGP as a method."""

from dataclasses import replace

import pytest
import torch

from bench.types import Budget, Log, NullProbe, Scene
from methods.instant_ngp.method import InstantNgp
from tests.common import refusal
from tests.methods.trainings import GRID, PIXEL, QUICK, TAUGHT, shows_the_ball
from tests.methods.usual import new_ngp

BUDGET = Budget("test", steps=8, samples=2048)


def fitted(scene: Scene, log: Log, device: str, budget: Budget = BUDGET, **options) -> InstantNgp:
    method = new_ngp(grid=GRID, training=QUICK, device=device, **options)
    method.fit(scene, budget, log)
    return method


def test_it_learns_a_ball(ball_scene, shared_log, device):
    method = fitted(ball_scene, shared_log, device, TAUGHT)
    shows_the_ball(method, ball_scene, 24, 2 * PIXEL)
    cameras = ball_scene.splits["test"].cameras
    frame = method.render(cameras[1], NullProbe())
    assert frame.alpha[16, 16] > 0.95
    method.render(cameras[0], NullProbe())  # changes nothing
    assert torch.equal(method.render(cameras[1], NullProbe()).rgb, frame.rgb)


def test_another_precision_is_another_training_of_its_own_size(ball_scene, quiet_log):
    first = fitted(ball_scene, quiet_log, "cpu")
    second = fitted(ball_scene, quiet_log, "cpu", precision="fp32")
    assert second.trained.field.packed is None
    for one in (first, second):
        assert one.train_s == one.trained.train_s > 0 < one.train_peak_bytes
        assert one.sizes() == one.trained.field.sizes() | {"occupancy": 128**3 // 8}
    assert not torch.equal(first.trained.field.table, second.trained.field.table)


@pytest.mark.parametrize(("has_products", "said"), [(True, "bf16"), (False, "bf16 in fp32")])
def test_settings_say_in_which_precision_a_field_is_multiplied(monkeypatch, has_products, said):
    known = {"cpu": has_products}
    monkeypatch.setattr("methods.instant_ngp.stage1.multiplies_bf16", known.__getitem__)
    for precision, shown in (("bf16", said), ("fp32", "fp32")):
        method = new_ngp(grid=GRID, training=QUICK, device="cpu", precision=precision)
        others = {"device": "cpu", "backend": "cpu", "engine": "none", "precision": "none"}
        assert method.settings() == {**others, "field_precision": shown}


def test_bfloat16_packs_two_features():
    with refusal(r"grid\.features is 4: use precision=fp32", ValueError):
        new_ngp(grid=replace(GRID, features=4), training=QUICK, device="cpu")

"""Instant-NGP as a method."""

import pytest
import torch

from bench.types import Budget, Log, NullProbe, Scene
from methods.instant_ngp.method import InstantNgp
from methods.kernels.encode import HashGrid
from tests.methods.trainings import GRID, PIXEL, QUICK, TAUGHT, shows_the_ball

BUDGET = Budget("test", steps=8, samples=2048)


def fitted(scene: Scene, log: Log, device: str, budget: Budget = BUDGET, **options) -> InstantNgp:
    method = InstantNgp(grid=GRID, training=QUICK, device=device, **options)
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
        assert one.train_s == one.trained.train_s > 0
        assert one.sizes() == one.trained.field.sizes() | {"occupancy": 128**3 // 8}
    assert not torch.equal(first.trained.field.table, second.trained.field.table)


@pytest.mark.parametrize(("has_products", "said"), [(True, "bf16"), (False, "bf16 in fp32")])
def test_settings_say_in_which_precision_a_field_is_multiplied(monkeypatch, has_products, said):
    known = {"cpu": has_products}
    monkeypatch.setattr("methods.instant_ngp.stage1.multiplies_bf16", known.__getitem__)
    for precision, shown in (("bf16", said), ("fp32", "fp32")):
        method = InstantNgp(grid=GRID, training=QUICK, device="cpu", precision=precision)
        others = {"device": "cpu", "backend": "cpu", "engine": "none", "precision": "none"}
        assert method.settings() == {**others, "field_precision": shown}


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"grid": HashGrid(features=4)}, r"grid\.features is 4: use precision=fp32"),
        ({"stop": 1.0}, "stop: expected a transmittance of 0 or more and less"),
        *(
            ({"device": name}, rf"^device: expected auto, .* got '{name}'")
            for name in ("", "gpu", "cpu:0", "meta")
        ),
    ],
)
def test_settings_that_make_no_sense_are_refused(wrong, message):
    with pytest.raises(ValueError, match=message):
        InstantNgp(**{"grid": GRID, "training": QUICK, "device": "cpu", **wrong})

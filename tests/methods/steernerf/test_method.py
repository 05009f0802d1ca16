"""The method as the harness uses it: trained, loaded again, rendered in sequence."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch

from bench.console import ConsoleLog
from bench.types import Budget, NullProbe
from methods.engines import Engine
from methods.engines.openvino_engine import OpenVino
from methods.engines.torch_engine import TorchEngine
from methods.steernerf.method import SteerNerf
from methods.steernerf.options import RangeReduction, Skips
from methods.steernerf.unet import UNet
from tests.common import refusal
from tests.methods.models import small_joint, small_model, small_motion, small_rendering
from tests.methods.trainings import GRID, QUICK

BUDGET = Budget("test", steps=40, samples=1024, renderer_steps=4)
RENDERER = partial(UNet, width=4, aligned=True)
RANGED = RangeReduction("paper", 0.03, "sum")


def new_method(
    frames: int = 2,
    rate: float = 1e-3,
    engine: Engine | None = None,
    device: str = "cpu",
    steps: int | None = None,
    **rendering: Any,
) -> SteerNerf:
    motion = small_motion(pool=2)
    return SteerNerf(
        grid=GRID,
        training=QUICK,
        model=small_model(channels=5, frames=frames, step=4.0),
        rendering=small_rendering(**{"step": 4.0} | rendering),
        renderer=RENDERER,
        joint=small_joint(patch=4, rate=rate, distilled_views=2, motion=motion),
        engine=engine or TorchEngine(),
        steps=steps,
        device=device,
        **{"name": "steernerf", "precision": "bf16", "backend": "auto", "seed": 0},
    )


@pytest.fixture
def log(tmp_path) -> ConsoleLog:
    return ConsoleLog(tmp_path)


def stages(folder: Path) -> list[str]:
    return sorted(path.name.split("-")[0] for path in (folder / "stages").iterdir())


def test_what_was_trained_is_found_again_and_renders_the_same(
    ball_scene, log, tmp_path, capsys, monkeypatch, device
):
    first, second = (new_method(device=device) for _ in range(2))
    first.fit(ball_scene, BUDGET, log)
    capsys.readouterr()
    monkeypatch.delattr(torch.optim, "Adam")  # which takes seconds to make, and is not needed
    second.fit(ball_scene, BUDGET, log)
    assert "training the 2D renderer: found in" in capsys.readouterr().err
    assert stages(tmp_path) == ["distilled", "field", "steernerf"]
    assert second.train_s == first.train_s > 0
    assert second.train_peak_bytes == first.train_peak_bytes >= first.trained.train_peak_bytes > 0
    for camera in ball_scene.splits["test"].cameras:
        frames = [method.render(camera, NullProbe()).rgb for method in (first, second)]
        assert torch.equal(*frames)


def test_steps_of_its_own_replace_those_of_the_budget(ball_scene, log, tmp_path):
    new_method().fit(ball_scene, BUDGET, log)
    more = replace(BUDGET, renderer_steps=BUDGET.renderer_steps + 1)
    new_method(steps=BUDGET.renderer_steps).fit(ball_scene, more, log)
    assert stages(tmp_path) == ["distilled", "field", "steernerf"]  # the same training
    new_method(frames=0).fit(ball_scene, more, log)  # on the same field
    assert stages(tmp_path) == ["distilled", "field", "steernerf", "steernerf"]


def test_reset_forgets_and_sizes_are_those_of_all_that_a_frame_needs(ball_scene, shared_log):
    method = new_method(rate=1e-2)
    method.fit(ball_scene, BUDGET, shared_log)
    camera = ball_scene.splits["test"].cameras[0]
    cold = method.render(camera, NullProbe()).rgb
    steady = method.render(camera, NullProbe()).rgb
    method.reset()
    assert torch.equal(method.render(camera, NullProbe()).rgb, cold)
    assert not torch.equal(steady, cold)
    assert method.memory == 2
    assert method.sizes()["renderer2d"] == 4 * sum(
        p.numel() for p in RENDERER(5, 2, 4).parameters()
    )
    assert set(method.sizes()) == {"hash_table", "field_networks", "occupancy", "renderer2d"}


@pytest.mark.slow
def test_a_network_is_built_once_for_each_training_and_for_no_other(ball_scene, log, tmp_path):
    def built(rate=1e-3, **rendering):
        method = new_method(rate=rate, engine=OpenVino("int8"), **rendering)
        method.fit(ball_scene, BUDGET, log)
        for camera in ball_scene.splits["test"].cameras:
            assert method.render(camera, NullProbe()).rgb.isfinite().all()
        return stages(tmp_path).count("network")

    assert built() == 1
    # Not trained for, nor calibrated for.
    assert built(range=RANGED, stop=0.1) == 1
    assert built(rate=3e-3) == 2


def test_shorter_examples_use_more_distilled_views():
    # 2 examples at the beginning, and 100 steps of 2 patches, 4 or 8 of an example.
    for uses, examples in ((4, 2 + 50), (8, 2 + 25)):
        options = small_joint(distilled_share=1.0, motion=small_motion(pool=2, uses=uses))
        assert options.distilled(100) == examples


def key_of(method: SteerNerf, **changed: Any) -> dict[str, object]:
    return replace(method.stage2, **changed).key(BUDGET)


def test_a_training_depends_on_its_model_and_on_nothing_that_is_chosen_afterwards():
    usual, skip = new_method(), Skips(empty=False, hidden=True, background=True)
    other = new_method(step=1.5, stop=1e-1, range=RANGED, skip=skip)
    assert key_of(other) == key_of(usual)
    everywhere = small_rendering(step=4.0)
    assert other.stage2.joint.rendering(other.stage2.model) == everywhere
    model = replace(usual.stage2.model, feature_background=1.0)
    assert key_of(usual, model=model) != key_of(usual)


def test_settings_that_do_not_fit_are_refused():
    """Range reduction needs preceding frames."""
    new_method(frames=1, range=RANGED)
    with refusal(r"range.mode: expected off without .* got paper", ValueError):
        new_method(frames=0, range=RANGED)


def test_a_training_that_ends_with_a_dead_network_fails(ball_scene, log, monkeypatch):
    monkeypatch.setattr(UNet, "alive", lambda renderer: False)
    with refusal(r"its units died in training .* smaller learning"):
        new_method().fit(ball_scene, BUDGET, log)

"""The method as the harness uses it: trained, loaded again, rendered in sequence."""

from __future__ import annotations

from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from methods.steernerf.training.sequences import MotionOptions

from bench.console import ConsoleLog
from bench.errors import Unavailable
from bench.types import Budget, Log, NullProbe, Scene
from methods.engines import Engine
from methods.engines.openvino_engine import OpenVino
from methods.engines.torch_engine import TorchEngine
from methods.instant_ngp.training import TrainingOptions
from methods.kernels.encode import HashGrid
from methods.steernerf.method import SteerNerf
from methods.steernerf.options import Model, RangeReduction, Rendering, Reprojection, Skips
from methods.steernerf.training.options import JointOptions
from methods.steernerf.unet import UNet
from methods.steernerf_lean.lean_renderer import LeanRenderer
from tests.methods.models import small_model, small_rendering
from tests.methods.trainings import GRID, QUICK

BUDGET = Budget("test", steps=40, samples=1024, renderer_steps=4)


RENDERER = partial(LeanRenderer, width=8, blocks=1, init="scratch")


def new_method(
    frames: int = 2,
    rate: float = 1e-3,
    engine: Engine | None = None,
    device: str = "cpu",
    after: float = 1.0,
    steps: int | None = None,
    **rendering: Any,
) -> SteerNerf:
    return SteerNerf(
        grid=GRID,
        training=QUICK,
        model=small_model(channels=5, frames=frames, step=4.0),
        rendering=small_rendering(**{"step": 4.0} | rendering),
        renderer=RENDERER,
        joint=JointOptions(
            patch=4,
            rate=rate,
            distilled_views=2,
            motion=MotionOptions(pool=2, length=2),
        ),
        engine=engine or TorchEngine(),
        after=after,
        steps=steps,
        device=device,
    )


@pytest.fixture
def log(tmp_path: Path) -> ConsoleLog:
    return ConsoleLog(tmp_path)


def stages(folder: Path) -> list[str]:
    return sorted(path.name.split("-")[0] for path in (folder / "stages").iterdir())


def test_what_was_trained_is_found_again_and_renders_the_same(
    ball_scene: Scene,
    log: ConsoleLog,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    device: str,
) -> None:
    first, second = (new_method(device=device) for _ in range(2))
    first.fit(ball_scene, BUDGET, log)
    capsys.readouterr()
    monkeypatch.delattr(torch.optim, "Adam")  # which takes seconds to make, and is not needed
    second.fit(ball_scene, BUDGET, log)
    assert "training the 2D renderer: found in" in capsys.readouterr().err
    inputs = ["inputs"] * (device == "cuda")  # for which the engine records the network
    assert stages(tmp_path) == ["distilled", "field", *inputs, "steernerf"]
    assert second.train_s == first.train_s > 0
    for camera in ball_scene.splits["test"].cameras:
        frames = [method.render(camera, NullProbe()).rgb for method in (first, second)]
        assert torch.equal(*frames)


def test_every_number_of_frames_shares_one_field(
    ball_scene: Scene, log: ConsoleLog, tmp_path: Path
) -> None:
    for frames in (0, 1):
        new_method(frames).fit(ball_scene, BUDGET, log)
    assert stages(tmp_path) == ["distilled", "field", "steernerf", "steernerf"]


def test_steps_of_its_own_replace_those_of_the_budget(
    ball_scene: Scene, log: ConsoleLog, tmp_path: Path
) -> None:
    new_method().fit(ball_scene, BUDGET, log)
    more = replace(BUDGET, renderer_steps=BUDGET.renderer_steps + 1)
    new_method(steps=BUDGET.renderer_steps).fit(ball_scene, more, log)
    assert stages(tmp_path) == ["distilled", "field", "steernerf"]  # the same training
    new_method().fit(ball_scene, more, log)
    assert stages(tmp_path) == ["distilled", "field", "steernerf", "steernerf"]


def test_reset_forgets(ball_scene: Scene, shared_log: Log) -> None:
    method = new_method(rate=1e-2)
    method.fit(ball_scene, BUDGET, shared_log)
    camera = ball_scene.splits["test"].cameras[0]
    cold = method.render(camera, NullProbe()).rgb
    steady = method.render(camera, NullProbe()).rgb
    method.reset()
    assert torch.equal(method.render(camera, NullProbe()).rgb, cold)
    assert not torch.equal(steady, cold)
    assert method.memory == 2


def test_sizes_are_those_of_all_that_a_frame_needs(ball_scene: Scene, shared_log: Log) -> None:
    method = new_method()
    method.fit(ball_scene, BUDGET, shared_log)
    renderer = RENDERER(5, 2, 4)
    numbers = sum(p.numel() for p in renderer.parameters())
    assert method.sizes()["renderer2d"] == 4 * numbers
    assert set(method.sizes()) == {"hash_table", "field_networks", "occupancy", "renderer2d"}


@pytest.mark.slow
def test_a_network_is_built_once_for_each_training_and_for_no_other(
    ball_scene: Scene, log: ConsoleLog, tmp_path: Path
) -> None:
    def built(rate: float = 1e-3, **rendering: Any) -> int:
        method = new_method(rate=rate, engine=OpenVino("int8"), **rendering)
        method.fit(ball_scene, BUDGET, log)
        for camera in ball_scene.splits["test"].cameras:
            assert method.render(camera, NullProbe()).rgb.isfinite().all()
        return stages(tmp_path).count("network")

    assert built() == 1
    # Not trained for, nor calibrated for.
    assert built(refined=0.5, range=RangeReduction("window"), overlap=0.9) == 1
    assert built(rate=3e-3) == 2


def test_an_engine_that_does_not_compute_on_the_device_is_refused() -> None:
    with pytest.raises(Unavailable, match="engine=openvino computes on the CPU"):
        OpenVino("fp32").check(torch.device("cuda"))


def test_shorter_sequences_use_more_distilled_views() -> None:
    options = JointOptions(distilled_share=1.0, motion=MotionOptions(pool=2, uses=4, longer=0.75))
    # 2 sequences at the beginning, and 100 steps of 2 patches, 4 of a sequence.
    assert options.distilled(100, frames=2) == 2 + 50 / 4 // 1 + 1
    assert options.distilled(100, frames=0) == 2 + 50


OTHERWISE: dict[str, Any] = {
    "channels": 6,
    "frames": 3,
    "scale": 2,
    "step": 2.0,
    "stop": 1e-2,
    "reprojection": Reprojection(rule="last"),
    "feature_background": 1.0,
    "history": False,
    "surface": False,
}
"""Another value of every field of a model."""

TURNED: dict[str, Any] = {
    "step": 1.5,
    "stop": 1e-1,
    "range": RangeReduction("paper", 0.1),
    "overlap": 0.5,
    "refined": 0.25,
    "refined_step": 2.0,
    "skip": Skips(empty=False),
}
"""Another value of every field of a rendering."""


def key_of(model: Model, rendering: Rendering) -> dict[str, object]:
    method = SteerNerf(
        grid=HashGrid(),
        training=TrainingOptions(),
        model=model,
        rendering=rendering,
        renderer=RENDERER,
        joint=JointOptions(),
        engine=TorchEngine(),
        device="cpu",
    )
    return method.stage2.key(BUDGET)


@pytest.mark.parametrize("name", [field.name for field in fields(Model)])
def test_every_field_of_a_model_is_in_the_key_of_its_training(name: str) -> None:
    usual = small_model()
    other = replace(usual, **{name: OTHERWISE[name]})
    assert other != usual
    assert key_of(other, small_rendering()) != key_of(usual, small_rendering())


@pytest.mark.parametrize("name", [field.name for field in fields(Rendering)])
def test_no_field_of_a_rendering_is_in_the_key_of_a_training(name: str) -> None:
    usual = small_rendering()
    other = replace(usual, **{name: TURNED[name]})
    assert other != usual
    assert key_of(small_model(), other) == key_of(small_model(), usual)


@pytest.mark.slow
@pytest.mark.parametrize("after", [0.125, 0.5, 1.0])
def test_the_weights_after_a_share_of_the_steps_are_of_the_same_training(
    ball_scene: Scene, log: ConsoleLog, tmp_path: Path, after: float
) -> None:
    whole, part = new_method(), new_method(after=after)
    assert part.stage2.key(BUDGET) == whole.stage2.key(BUDGET)
    for method in (whole, part):
        method.fit(ball_scene, BUDGET, log)
    assert stages(tmp_path).count("steernerf") == 1
    one, other = (m.pipeline.renderer.state_dict() for m in (whole, part))
    same = all(torch.equal(one[name], other[name]) for name in one)
    assert same == (after == 1)
    assert (part.train_s < whole.train_s) == (after < 1)


def test_an_unknown_share_of_the_steps_is_refused() -> None:
    with pytest.raises(ValueError, match=r"^after: expected 0\.125, 0\.25, 0\.5 or 1, got 0\.3$"):
        new_method(after=0.3)


def test_training_renders_everywhere_whatever_is_chosen_afterwards() -> None:
    model = small_model(step=2.0, stop=1e-2)
    rendering = Rendering.in_training(model, refined=0.2, refined_step=3.0)
    assert (rendering.step, rendering.stop, rendering.refined) == (2.0, 1e-2, 0.2)
    assert (rendering.range.mode, rendering.overlap, rendering.refined_step) == ("off", 0.0, 3.0)
    assert rendering.skip == Skips()


def refused(**others: Any) -> SteerNerf:
    parts: dict[str, Any] = {
        "model": small_model(history=False, surface=False),
        "rendering": small_rendering(),
        "renderer": UNet,
        "joint": JointOptions(refined=0.0),
    }
    return SteerNerf(
        grid=HashGrid(),
        training=TrainingOptions(),
        engine=TorchEngine(),
        device="cpu",
        **parts | others,
    )


def test_a_renderer_that_does_not_estimate_its_error_cannot_be_refined() -> None:
    refused()  # as it is, it is not
    said = "UNet does not estimate its error, expected 0, got 0.1"
    with pytest.raises(ValueError, match=rf"^rendering\.refined: {said}"):
        refused(rendering=small_rendering(refined=0.1))
    with pytest.raises(ValueError, match=rf"^joint\.refined: {said}"):
        refused(joint=JointOptions(refined=0.1))


def test_where_the_depth_is_kept_no_sum_can_be_reprojected() -> None:
    kept = {
        depth: small_model(history=False, surface=False, reprojection=Reprojection(depth=depth))
        for depth in ("expected", "sum")
    }
    wanted = small_rendering(range=RangeReduction("paper", depth="sum"))
    refused(model=kept["sum"], rendering=wanted)  # there it can
    with pytest.raises(ValueError, match=r"range\.depth: expected the depth that is kept"):
        refused(model=kept["expected"], rendering=wanted)


@pytest.mark.parametrize("mode", ["paper", "window"])
def test_without_preceding_frames_there_is_no_range_reduction(mode: str) -> None:
    ranged = small_rendering(range=RangeReduction(mode))
    refused(rendering=ranged)  # with them there is
    with pytest.raises(ValueError, match=rf"range.mode: expected off without .* got {mode}"):
        refused(model=small_model(frames=0, history=False, surface=False), rendering=ranged)


def test_a_rendering_may_be_exchanged_between_frames(ball_scene: Scene, shared_log: Log) -> None:
    method = new_method(refined=1.0)
    method.fit(ball_scene, BUDGET, shared_log)
    camera = ball_scene.splits["test"].cameras[0]
    refined = method.render(camera, NullProbe()).rgb
    method.reset()
    method.rendering = replace(method.rendering, refined=0.0)
    drawn = method.render(camera, NullProbe()).rgb
    assert not torch.equal(drawn, refined)


@pytest.mark.parametrize("name", ["history", "surface"])
def test_what_the_renderer_does_not_read_is_refused(name: str) -> None:
    only = {"history": False, "surface": False} | {name: True}
    with pytest.raises(ValueError, match=rf"^model\.{name}: UNet does not read it"):
        refused(model=small_model(**only))
    refused(model=small_model(**only), renderer=RENDERER)

"""The method as the harness uses it: trained, loaded again, rendered in sequence."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import pytest
import torch

from bench.console import ConsoleLog
from bench.errors import Unavailable
from bench.probes import StageClock
from bench.types import Budget, NullProbe, Scene
from methods.engines import Engine
from methods.engines.openvino_engine import OpenVino
from methods.engines.torch_engine import TorchEngine
from methods.instant_ngp.training import TrainingOptions
from methods.kernels.encode import HashGrid
from methods.steernerf.beyond.lean_renderer import SpaceToDepth
from methods.steernerf.method import SteerNerf
from methods.steernerf.options import PipelineOptions
from methods.steernerf.training.joint import JointOptions
from methods.steernerf.training.sequences import MotionOptions
from tests.methods.conftest import look_at_the_middle

BUDGET = Budget("test", steps=40, samples=4096, renderer_steps=4)


def new_method(
    frames: int = 2,
    rate: float = 1e-3,
    engine: Engine | None = None,
    refined: float = 0.0,
    device: str = "cpu",
) -> SteerNerf:
    return SteerNerf(
        grid=HashGrid(levels=8, log2_table=12, n_min=8, n_max=64),
        training=TrainingOptions(),
        pipeline=PipelineOptions(channels=5, frames=frames, steps=4, refined=refined),
        renderer=partial(SpaceToDepth, width=8, blocks=1, init="scratch"),
        joint=JointOptions(
            patch=4,
            rate=rate,
            distilled_views=2,
            motion=MotionOptions(pool=2, length=2),
        ),
        engine=engine or TorchEngine(),
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
    device: str,
) -> None:
    first, second = (new_method(device=device) for _ in range(2))
    first.fit(ball_scene, BUDGET, log)
    capsys.readouterr()
    second.fit(ball_scene, BUDGET, log)
    assert "training steernerf: found in" in capsys.readouterr().err
    assert stages(tmp_path) == ["distilled", "field", "steernerf"]
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


def test_reset_forgets(ball_scene: Scene, log: ConsoleLog) -> None:
    method = new_method(rate=1e-2)
    method.fit(ball_scene, BUDGET, log)
    camera = ball_scene.splits["test"].cameras[0]
    cold = method.render(camera, NullProbe()).rgb
    steady = method.render(camera, NullProbe()).rgb
    method.reset()
    assert torch.equal(method.render(camera, NullProbe()).rgb, cold)
    assert not torch.equal(steady, cold)
    assert method.memory == 2


def test_a_foreseen_frame_is_begun_before_unless_a_sequence_begins(
    ball_scene: Scene, log: ConsoleLog
) -> None:
    method = new_method()
    method.fit(ball_scene, BUDGET, log)
    first, second = ball_scene.splits["test"].cameras[:2]
    clock, threads = StageClock("cpu"), torch.get_num_threads()
    pictures = []
    try:
        torch.set_num_threads(2)
        for foreseen, reset in ((False, False), (True, False), (True, True)):
            method.reset()
            assert not foreseen or method.foresee(second)
            method.render(first, NullProbe())
            if reset:
                method.reset()
            with clock.frame():
                pictures.append(method.render(second, clock).rgb)
    finally:
        torch.set_num_threads(threads)
    assert ["field" in frame.stages_ns for frame in clock.frames] == [True, False, True]
    assert torch.equal(pictures[0], pictures[1])
    assert not torch.equal(pictures[0], pictures[2])  # which no frame precedes


@pytest.mark.parametrize(("threads", "safe"), [(1, True), (2, False)])
def test_where_two_threads_cannot_be_at_work_nothing_is_begun_before(
    monkeypatch: pytest.MonkeyPatch, threads: int, safe: bool
) -> None:
    monkeypatch.setattr("torch.get_num_threads", lambda: threads)
    monkeypatch.setattr(
        "methods.steernerf.method.serves_many_threads", lambda backend, device: safe
    )
    method = new_method()
    assert not method.foresee(look_at_the_middle(0.1, 0.3))
    assert method.lookahead._upcoming is None


def test_sizes_are_those_of_all_that_a_frame_needs(ball_scene: Scene, log: ConsoleLog) -> None:
    method = new_method()
    method.fit(ball_scene, BUDGET, log)
    renderer = SpaceToDepth(5, 2, 4, width=8, blocks=1, init="scratch")
    numbers = sum(p.numel() for p in renderer.parameters())
    assert method.sizes()["renderer2d"] == 4 * numbers
    assert set(method.sizes()) == {"hash_table", "field_networks", "occupancy", "renderer2d"}


def test_a_network_is_built_once_for_each_training_and_for_no_other(
    ball_scene: Scene, log: ConsoleLog, tmp_path: Path
) -> None:
    def built(rate: float = 1e-3, refined: float = 0.0) -> int:
        method = new_method(rate=rate, engine=OpenVino("int8"), refined=refined)
        method.fit(ball_scene, BUDGET, log)
        for camera in ball_scene.splits["test"].cameras:
            assert method.render(camera, NullProbe()).rgb.isfinite().all()
        return stages(tmp_path).count("network")

    assert built() == 1
    assert built(refined=0.5) == 1  # not trained for, nor calibrated for
    assert built(rate=3e-3) == 2


def test_an_engine_that_does_not_compute_on_the_device_is_refused() -> None:
    with pytest.raises(Unavailable, match="engine=openvino computes on the CPU"):
        OpenVino("fp32").check(torch.device("cuda"))


def test_what_begins_anew_more_often_has_a_use_for_more_distilled_views() -> None:
    options = JointOptions(distilled_share=1.0, motion=MotionOptions(pool=2, uses=4, longer=0.75))
    # 2 sequences at the beginning, and 100 steps of 2 patches, 4 of a sequence.
    assert options.distilled(100, frames=2) == 2 + 50 / 4 // 1 + 1
    assert options.distilled(100, frames=0) == 2 + 50

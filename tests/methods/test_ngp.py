"""Instant-NGP as a method."""

from __future__ import annotations

import pytest
import torch

from bench.metrics import psnr
from bench.types import EMPTY_ALPHA, Budget, Log, NullProbe, Scene
from methods.kernels.encode import HashGrid
from methods.ngp import InstantNgp
from methods.train import TrainingOptions

GRID = HashGrid(levels=8, log2_table=12, n_min=8, n_max=64)


def fitted(scene: Scene, log: Log, device: str, steps: int = 8, **options) -> InstantNgp:
    method = InstantNgp(grid=GRID, training=TrainingOptions(), device=device, **options)
    method.fit(scene, Budget("test", steps=steps, samples=8192), log)
    return method


def test_it_learns_a_ball(ball_scene: Scene, quiet_log: Log, device: str) -> None:
    method = fitted(ball_scene, quiet_log, device, steps=400)
    test = ball_scene.splits["test"]
    frame = method.render(test.cameras[1], NullProbe())
    truth = test.images[1].float() / 255
    on_white = truth[..., :3] * truth[..., 3:] + 1 - truth[..., 3:]
    assert psnr(frame.rgb.cpu(), on_white) > 24
    # Depth is that of the front of the ball, 1.6 - 0.3 from the camera, to two pixels' widths.
    assert abs(frame.depth[16, 16].item() - 1.3) < 2 * 1.6 / 40
    assert frame.alpha[16, 16] > 0.95
    assert frame.depth[0, 0] == torch.inf
    assert torch.equal(frame.depth.isinf(), frame.alpha <= EMPTY_ALPHA)
    assert (frame.rgb[frame.alpha == 0] == 1).all()


def test_sizes_settings_and_training_time(ball_scene: Scene, quiet_log: Log) -> None:
    method = fitted(ball_scene, quiet_log, "cpu")
    assert method.sizes() == method.field.sizes() | {"occupancy": 128**3 // 8}
    assert method.settings() == {
        "device": "cpu",
        "backend": "cpu",
        "engine": "torch",
        "precision": "bf16",
    }
    assert method.train_s > 0
    again = fitted(ball_scene, quiet_log, "cpu")
    assert again.train_s == method.train_s  # of the training, not of loading its result


def test_another_precision_is_another_training(ball_scene: Scene, quiet_log: Log) -> None:
    first = fitted(ball_scene, quiet_log, "cpu")
    second = fitted(ball_scene, quiet_log, "cpu", precision="fp32")
    assert second.field.packed is None
    assert not torch.equal(first.field.table, second.field.table)


def test_frames_do_not_depend_on_one_another(ball_scene: Scene, quiet_log: Log) -> None:
    method = fitted(ball_scene, quiet_log, "cpu")
    first, second = ball_scene.splits["test"].cameras[:2]
    alone = method.render(first, NullProbe()).rgb
    method.render(second, NullProbe())
    assert torch.equal(method.render(first, NullProbe()).rgb, alone)


def test_a_packed_table_needs_two_features() -> None:
    with pytest.raises(ValueError, match=r"grid\.features is 4: use precision=fp32"):
        InstantNgp(grid=HashGrid(features=4), training=TrainingOptions(), device="cpu")

"""Instant-NGP as a method."""

from __future__ import annotations

import pytest
import torch

from bench.metrics import psnr
from bench.types import EMPTY_ALPHA, Budget, Log, NullProbe, Scene
from methods.instant_ngp.method import InstantNgp
from methods.instant_ngp.stage1 import Pretrained
from methods.instant_ngp.training import TrainingOptions
from methods.kernels.encode import HashGrid
from methods.kernels.march import Occupancy
from methods.steernerf.range_reduction import KEPT_ALPHA, RangeReduction
from tests.methods.conftest import Work, look_at_the_middle
from tests.methods.solids import Solid, ball

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
    assert method.sizes() == method.trained.field.sizes() | {"occupancy": 128**3 // 8}
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
    assert second.trained.field.packed is None
    assert not torch.equal(first.trained.field.table, second.trained.field.table)


def test_frames_do_not_depend_on_one_another(ball_scene: Scene, quiet_log: Log) -> None:
    method = fitted(ball_scene, quiet_log, "cpu")
    first, second = ball_scene.splits["test"].cameras[:2]
    alone = method.render(first, NullProbe()).rgb
    method.render(second, NullProbe())
    assert torch.equal(method.render(first, NullProbe()).rgb, alone)


def of_a_ball(**options) -> InstantNgp:
    """A method whose field is a solid ball, with some space around it to look through."""
    method = InstantNgp(grid=GRID, training=TrainingOptions(), device="cpu", **options)
    axis = (torch.arange(32) + 0.5) / 32
    cells = torch.cartesian_prod(axis, axis, axis).view(32, 32, 32, 3)
    occupancy = Occupancy((cells - 0.5).norm(dim=-1) < 0.45)
    method.trained = Pretrained(Solid(ball(), channels=3), occupancy, 0.0)  # type: ignore[arg-type]
    method.background = torch.ones(3)
    return method


def test_a_guided_frame_is_much_like_one_that_stands_alone() -> None:
    alone, guided = of_a_ball(), of_a_ball(range=RangeReduction(epsilon=0.06))
    assert (alone.memory, guided.memory) == (0, 1)
    first, second = look_at_the_middle(0.2, 0.3), look_at_the_middle(0.203, 0.3)
    counts = []
    for method in (alone, guided):
        method.reset()
        cold, warm = Work(), Work()
        frames = [method.render(first, cold), method.render(second, warm)]
        counts.append((cold.done["samples"], warm.done["samples"], frames))
    (cold_alone, all_samples, whole), (cold_guided, fewer, narrowed) = counts
    # The first frame of a sequence has nothing to be guided by.
    assert cold_guided == cold_alone
    assert torch.equal(narrowed[0].rgb, whole[0].rgb)
    # Rays end at KEPT_ALPHA of what is expected: that share of their colour, in [0, 1], is
    # missing.
    missing = 1 - KEPT_ALPHA + 1e-4
    torch.testing.assert_close(narrowed[1].rgb, whole[1].rgb, rtol=0, atol=missing)
    assert fewer < 0.9 * all_samples

    guided.reset()
    again = guided.render(second, NullProbe())
    assert torch.equal(again.rgb, whole[1].rgb)


def test_a_packed_table_needs_two_features() -> None:
    with pytest.raises(ValueError, match=r"grid\.features is 4: use precision=fp32"):
        InstantNgp(grid=HashGrid(features=4), training=TrainingOptions(), device="cpu")


def test_a_stop_that_ends_every_ray_at_once_is_refused() -> None:
    with pytest.raises(ValueError, match=r"stop: expected a transmittance of 0 or more and less"):
        InstantNgp(grid=HashGrid(), training=TrainingOptions(), stop=1.0, device="cpu")


@pytest.mark.parametrize("device", ["", "gpu", "cpu:0", "meta"])
def test_what_is_no_name_of_a_device_is_refused(device: str) -> None:
    with pytest.raises(ValueError, match=rf"^device: expected auto, .* got '{device}'"):
        InstantNgp(grid=GRID, training=TrainingOptions(), device=device)

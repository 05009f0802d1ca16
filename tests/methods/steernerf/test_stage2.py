"""Stage 2: the gradient of the whole chain, what is trained, killed trainings, the guard."""

from dataclasses import replace
from functools import partial

import pytest
import torch

from bench.types import Scene, Split
from methods.instant_ngp.field import HashField
from methods.steernerf.options import JointOptions
from methods.steernerf.patches import Patches
from methods.steernerf.pipeline import Pipeline
from methods.steernerf.stage2 import JointTraining
from methods.steernerf.unet import UNet
from tests.common import refusal, seeded
from tests.methods.models import misty_field, small_joint, small_model, small_motion, trained_field
from tests.methods.trainings import does_not_see_what_masks_hide, goes_on_after_a_kill

MOTION = small_motion(pool=3, uses=4)
OPTIONS = small_joint(patch=4, batch=2, motion=MOTION)


def new_training(
    scene: Scene,
    options: JointOptions = OPTIONS,
    field: HashField | None = None,
    frames: int = 2,
    steps: int = 12,
) -> JointTraining:
    torch.manual_seed(0)
    model = small_model(frames=frames)
    trained = trained_field(field or misty_field(channels=model.channels))
    renderer = UNet(model.channels, frames, model.scale, width=8, aligned=True)
    pipeline = Pipeline(trained, scene.background, renderer, model)
    patches = Patches(pipeline, scene, Split([], [], []), options, seeded(1))
    return JointTraining(renderer, patches, steps, trained if patches.learning else None)


def test_masked_pixels_are_not_learnt_from(ball_scene):
    does_not_see_what_masks_hide(new_training, ball_scene)


def test_the_gradient_of_the_whole_chain_is_that_of_the_loss(ball_scene, monkeypatch):
    """In float64, along a random direction of all parameters, against a central difference.

    Table, networks and renderer are differentiated through compositing, the splatted features of
    two preceding frames, and the 2D renderer; depths, and so places, are constants.
    """
    field = misty_field("fp32", "reference").double()
    options = replace(OPTIONS, motion=replace(MOTION, pool=4))
    training = new_training(ball_scene, options, field.float())
    renderer, pipeline = training.renderer, training.patches.pipeline
    patches = [training.patches.cut(training.patches.example()) for _ in range(8)]
    assert [len(patch.points) for patch in patches[:2]] == [2, 2]
    field.double(), renderer.double()
    pipeline.background = torch.ones(4, dtype=torch.float64)
    field.gradients = None
    monkeypatch.setattr(torch, "zeros", partial(torch.zeros, dtype=torch.float64))  # of a canvas
    doubled = [[replace(of, values=of.values.double()) for of in p.points] for p in patches[:2]]
    patches = [replace(p, points=of) for p, of in zip(patches, doubled, strict=False)]
    truth = torch.stack([patch.truth for patch in patches])

    def loss():
        batch = training.patches.render(patches)
        error = (renderer(batch.observations) - truth).square().mean()
        return error + 1e-2 * batch.opacity.square().mean()

    parameters = [field.table, *field.layers.values(), *renderer.parameters()]
    gradient = torch.autograd.grad(loss(), parameters)
    assert all(g.abs().max() > 0 for g in gradient)
    generator, step = seeded(0), 1e-8  # so short that it hardly ever crosses a ReLU's kink
    for part in (slice(1), slice(1, 6), slice(6, None)):
        group = parameters[part]
        ways = [torch.randn(p.shape, generator=generator).double() for p in group]
        slope = sum(map(torch.sum, map(torch.mul, gradient[part], ways))).item()
        values = []
        with torch.no_grad():
            for share in (step, -2 * step):
                torch._foreach_add_(group, ways, alpha=share)
                values.append(loss().item())
            torch._foreach_add_(group, ways, alpha=step)
        assert (values[0] - values[1]) / (2 * step) == pytest.approx(slope, rel=1e-4)


@pytest.mark.parametrize("field", ["joint", "frozen"])
def test_the_renderer_learns_and_the_field_unless_it_is_frozen(ball_scene, field):
    learned = misty_field()
    training = new_training(ball_scene, replace(OPTIONS, field=field), learned)
    parts = dict(training.renderer.state_dict(prefix="renderer."))
    parts |= {name: x for name, x in learned.state_dict().items() if x.is_floating_point()}
    before = {name: x.clone() for name, x in parts.items()}
    for _ in range(3):
        training.advance()
    changed = {name for name, x in parts.items() if not torch.equal(x, before[name])}
    of_field = {"table", "layers.density_out", "layers.feature_out"}
    assert {name for name in parts if name.startswith("renderer.")} <= changed
    assert of_field <= changed if field == "joint" else changed.isdisjoint(learned.state_dict())


def test_both_learning_rates_of_the_release_fall_twice_to_the_same(ball_scene):
    """From 3e-3 and 1e-4 to 5e-5, back, and to 5e-5 again: each in a third of the steps."""
    options = replace(OPTIONS, rate=1e-4, field_rate=3e-3, final_rate=5e-5, half_waves=3)
    training = new_training(ball_scene, options, steps=30)
    for first in (1e-4, 3e-3):
        rates = []
        for training.step in range(31):
            rates.append(training.rate_now(first))
        assert [rates[n] for n in (0, 10, 20, 30)] == pytest.approx([first, 5e-5, first, 5e-5])
        assert rates[15] == pytest.approx((first + 5e-5) / 2)
    training.step = 10
    training.advance()
    assert training.optimisers()["adam"].param_groups[0]["lr"] == pytest.approx(5e-5)


def test_the_density_grid_follows_the_field_if_it_is_to(ball_scene):
    """The field of the test is dense everywhere, the grid knows of a shell alone: half of the
    visits are to any cell."""
    for visits in (0, 512):
        training = new_training(ball_scene, replace(OPTIONS, grid_samples=visits))
        before = training.trained.grid.density.clone()
        occupancy = training.patches.pipeline.occupancy
        training.advance()
        changed = not torch.equal(training.trained.grid.density, before)
        assert changed == (visits > 0)
        kept = training.result()["grid.density"]
        assert torch.equal(kept, training.trained.grid.density)
        assert training.patches.pipeline.occupancy is (
            training.trained.grid.occupancy if visits else occupancy
        )


@pytest.mark.parametrize("optimiser", ["muon", "adam"])
def test_a_killed_training_ends_as_if_it_had_never_stopped(ball_scene, tmp_path, optimiser):
    """The examples go on, too. Kernels of the U-Net are channels last, and files keep no order;
    optimisers read both as they lie."""
    options = replace(OPTIONS, optimiser=optimiser, motion=small_motion(pool=2, uses=3))
    goes_on_after_a_kill(lambda: new_training(ball_scene, options, steps=8), 5, tmp_path)


def test_a_loss_that_is_no_number_stops_and_names_what_is_not_finite(ball_scene):
    training = new_training(ball_scene)
    with torch.no_grad():
        training.renderer.network.last.bias[0] = torch.nan
    with refusal(r"step 0: not finite: .*renderer\.network\.last\.bias.*rate"):
        training.advance()

"""What a mask hides is not learnt from, by whatever trains."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from bench.types import Budget, Scene, Split
from methods.gaussians.model import Gaussians
from methods.gaussians.training import GaussianTraining, anywhere, spacing
from methods.instant_ngp.field import HashField
from methods.instant_ngp.table import detail
from methods.instant_ngp.training import FieldTraining
from methods.steernerf.patches import Patches
from methods.steernerf.pipeline import Pipeline
from methods.steernerf.stage2 import JointTraining
from methods.steernerf.unet import UNet
from methods.training import loop
from tests.methods.models import misty_field, small_joint, small_model, small_motion, trained_field
from tests.methods.trainings import GRID, QUICK, TEACHER
from tests.methods.usual import usual

STEPS = 8


def field(scene: Scene) -> FieldTraining:
    made = HashField(GRID, generator=torch.Generator().manual_seed(0))
    return FieldTraining(made, scene, Budget("test", steps=STEPS, samples=1024), QUICK, seed=0)


def gaussians(scene: Scene) -> GaussianTraining:
    points, colours = anywhere(scene, 200, torch.Generator().manual_seed(0))
    made = Gaussians.at(points, colours, 0.5 * spacing(points), 0.5, degree=0)
    fitting = usual("method/gaussians", "fitting", half=0.5)  # half of the steps are of half a size
    return GaussianTraining(made, scene, STEPS, fitting, TEACHER)


def stage2(scene: Scene) -> JointTraining:
    torch.manual_seed(0)
    model = small_model()
    trained = trained_field(misty_field(channels=model.channels))
    renderer = UNet(model.channels, model.frames, model.scale, width=8)
    pipeline = Pipeline(trained, scene.background, renderer, model)
    options = small_joint(patch=4, motion=small_motion(pool=3, uses=4))
    generator = torch.Generator().manual_seed(1)
    patches = Patches(pipeline, scene, Split([], [], []), options, generator)
    return JointTraining(renderer, patches, STEPS, trained)


@pytest.mark.parametrize("begin", [field, gaussians, stage2])
def test_a_training_does_not_see_what_masks_hide(
    ball_scene: Scene, begin: Callable[[Scene], loop.Training]
) -> None:
    split = ball_scene.splits["train"]
    generator = torch.Generator().manual_seed(0)
    hidden = torch.nn.functional.interpolate(  # in pieces that are no blocks of two
        torch.rand(1, 1, 11, 11, generator=generator), size=(32, 32)
    )[0, 0]
    mask = hidden < 0.6
    spoiled = [torch.where(mask[..., None], image, 255 - image) for image in split.images]

    def result(images: Sequence[Tensor], masks: Sequence[Tensor | None]) -> dict[str, Tensor]:
        train = replace(split, images=images, masks=masks)
        assert detail(train) == detail(replace(train, images=split.images)) or not masks
        training = begin(replace(ball_scene, splits={"train": train}))
        while training.step < STEPS:
            training.advance()
        return {name: value.clone() for name, value in training.result().items()}

    def equal(one: dict[str, Tensor], other: dict[str, Tensor]) -> bool:
        return all(torch.equal(one[name], other[name]) for name in one)

    masks = [mask] * len(split)
    learnt = result(split.images, masks)
    assert equal(learnt, result(spoiled, masks))
    assert not equal(learnt, result(split.images, ()))
    plain = result(split.images, ())
    assert equal(plain, result(split.images, [None] * len(split)))
    assert not equal(plain, result(spoiled, ()))

"""The field that most tests begin with, and what is asked of every method that trains: what it
learned, and that a kill changes nothing."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from bench.metrics import psnr
from bench.types import EMPTY_ALPHA, Budget, Method, NullProbe, Scene, composite
from methods.instant_ngp.stage1 import Setup
from methods.instant_ngp.table import detail
from methods.kernels.encode import HashGrid
from methods.training import loop
from tests.common import assert_near, seeded
from tests.methods.usual import field_options

PIXEL = 1.6 / 40
"""Width of a pixel of the ball's pictures, in its middle."""

GRID = HashGrid(levels=8, features=2, log2_table=12, n_min=8, n_max=64)

QUICK = field_options(march_step=8.0, grid_samples=1 << 15)
"""Few samples of a ray and few visits of the density grid: enough for a ball."""

TEACHER = Setup.resolved(GRID, QUICK, "bf16", "auto", "cpu", seed=0)
TAUGHT = Budget("test", steps=200, samples=2048, renderer_steps=40)
"""Of the fixture `teacher`."""

EXACT_GRID = HashGrid(levels=16, features=2, log2_table=10, n_min=4, n_max=64)
EXACT_TEACHER = Setup.resolved(EXACT_GRID, QUICK, "fp32", "auto", "cpu", seed=0)
"""Of networks whose products are in the precision of their teacher's."""


def quality(method: Method, scene: Scene, split: str = "test", view: int = 1) -> float:
    """PSNR of a view of `scene`, in dB; of the ball a white picture has 11.4."""
    some = scene.splits[split]
    truth = composite(some.images[view], scene.background)
    return psnr(method.render(some.cameras[view], NullProbe()).rgb.cpu(), truth)


def shows_the_ball(method: Method, scene: Scene, least: float, off: float) -> None:
    """Assert that a view has a PSNR of `least` dB, shows the background where nothing is, and in
    its middle the depth of the front of the ball, 1.6 - 0.3 from the camera, to `off`: in the
    median, as the ball has one colour, which leaves the depth of a single pixel to chance."""
    assert quality(method, scene) > least
    frame = method.render(scene.splits["test"].cameras[1], NullProbe())
    assert abs(frame.depth[14:19, 14:19].median().item() - 1.3) < off
    assert torch.equal(frame.depth.isinf(), frame.alpha <= EMPTY_ALPHA)
    assert (frame.rgb[frame.alpha == 0] == 1).all()


def goes_on_after_a_kill(new: Callable[[], loop.Training], killed_at: int, folder: Path) -> None:
    """Assert that a training that is stopped after `killed_at` steps and goes on from its
    checkpoint ends with the same numbers as one that was not; `new` begins one."""
    whole, half, resumed = new(), new(), new()
    for _ in range(killed_at):
        half.advance()
    loop.save(half, folder / "half")
    loop.load(resumed, folder / "half")
    for training in (whole, resumed):
        while training.step < training.steps:
            training.advance()
    assert_near(resumed.result(), whole.result(), atol=0)


def does_not_see_what_masks_hide(begin: Callable[[Scene], loop.Training], scene: Scene) -> None:
    """Assert that what masks hide in the pictures of `scene` changes nothing in eight steps of the
    training that `begin` makes, and that everything else would."""
    split = scene.splits["train"]
    noise = torch.rand(1, 1, 11, 11, generator=seeded(0))
    mask = torch.nn.functional.interpolate(noise, size=split.images[0].shape[:2])[0, 0] < 0.6
    spoiled = [torch.where(mask[..., None], image, 255 - image) for image in split.images]

    def learnt(images: Sequence[Tensor], masks: Sequence[Tensor | None]) -> tuple[float, ...]:
        train = replace(split, images=images, masks=masks)
        training = begin(replace(scene, splits={"train": train}))
        for _ in range(8):
            training.advance()
        return detail(train), *(x.double().sum().item() for x in training.result().values())

    masks, nothing = [mask] * len(split), [None] * len(split)
    masked, plain = learnt(split.images, masks), learnt(split.images, ())
    assert learnt(spoiled, masks) == masked != plain != learnt(spoiled, ())
    assert learnt(split.images, nothing) == plain


@contextmanager
def killed(kind: Any, step: int) -> Iterator[None]:
    """In here the trainings of a class `kind`, which leave a checkpoint behind at every step, are
    interrupted before they take `step`; assert that one was."""
    advance = kind.advance

    def advance_or_die(training: Any) -> dict[str, float]:
        if training.step == step:
            raise KeyboardInterrupt
        return advance(training)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop, "CHECKPOINT_S", -1.0)
        patch.setattr(kind, "advance", advance_or_die)
        with pytest.raises(KeyboardInterrupt):
            yield

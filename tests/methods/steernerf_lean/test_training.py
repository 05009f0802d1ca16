"""Stage 2 of the lean method: its losses, its patches, the mean of its weights; a renderer for any
scene, trained on several."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file
from torch import Tensor

from bench.console import ConsoleLog
from bench.types import Budget, Log, NullProbe, Scene, Split, SteerbenchError
from methods.steernerf.patches import Batch
from methods.steernerf.stage2 import JointTraining
from methods.steernerf_lean import lean_renderer as renderers
from methods.steernerf_lean.cells import pixels_of
from methods.steernerf_lean.lean_renderer import LeanRenderer
from methods.steernerf_lean.pipeline import LeanPipeline
from methods.steernerf_lean.training import (
    LEAST_ERROR,
    AnyOf,
    LeanPatches,
    LeanStage2,
    LeanTraining,
)
from methods.training import checkpoint
from tests.methods.models import (
    lean_joint,
    lean_model,
    lean_renderer,
    misty_field,
    small_motion,
    trained_field,
)
from tests.methods.observations import shaken
from tests.methods.trainings import TEACHER, goes_on_after_a_kill

MOTION = small_motion(pool=3, uses=4, length=2)
OPTIONS = lean_joint(patch=4, motion=MOTION, refined=0.0)
RENDERER = partial(LeanRenderer, width=8, blocks=1, init="pretrained")
BUDGET = Budget("test", steps=40, samples=1024, renderer_steps=8)


def new_training(scene: Scene, options=OPTIONS, frames: int = 1, steps: int = 12) -> LeanTraining:
    torch.manual_seed(0)
    model, trained = lean_model(frames=frames), trained_field(misty_field())
    pipeline = LeanPipeline(trained, scene.background, lean_renderer(model), model)
    generator = torch.Generator().manual_seed(1)
    patches = LeanPatches(pipeline, scene, Split([], [], []), options, generator)
    training = LeanTraining(pipeline.renderer, patches, steps, trained)
    pipeline.renderer = training.outcome
    return training


def refinement_loss(training: LeanTraining, batch: Batch) -> Tensor | float:
    return training.refinement_loss(training.renderer(batch.observations), batch)


def test_the_field_learns_from_the_pixels_it_is_to_refine(ball_scene: Scene) -> None:
    """From all of them: the squared error of the field's own rays, over all numbers of the
    pictures. From some: the same in the mean."""
    training = new_training(ball_scene, replace(OPTIONS, refined=0.25, refined_rays=10**6))
    shaken(training.renderer)
    batch = training.patches.draw(2)
    estimated = training.renderer(batch.observations).error
    pipeline, rendering = training.patches.pipeline, training.patches.rendering
    error, first = 0.0, 0
    for o, view, truth in zip(batch.observations, batch.views, batch.truth, strict=True):
        own = estimated[first : first + len(o.cells)]
        first += len(o.cells)
        worst = o.cells[own.sort(descending=True).indices[: math.ceil(0.25 * len(own))]]
        shown = pipeline.refined(worst, view, rendering, NullProbe())
        error += (shown - pixels_of(truth, worst, 4)).square().sum().item()
    whole = refinement_loss(training, batch)
    # The same samples, taken in rounds or at once, and a thousand squares added up.
    torch.testing.assert_close(whole.item(), error / batch.truth.numel(), rtol=1e-4, atol=0)
    whole.backward()
    assert training.trained is not None
    _, gradients = training.trained.field.gradients.joined()
    assert gradients.any()

    training.options = replace(training.options, refined_rays=64)
    some = torch.stack([refinement_loss(training, batch).detach() for _ in range(80)])
    # 5 standard deviations of the mean of 80.
    assert (some.mean() - whole.detach()).abs() < 5 * some.std() / math.sqrt(80)


def test_the_estimated_error_learns_the_log_of_the_error(ball_scene: Scene) -> None:
    training = new_training(ball_scene)
    batch = training.patches.draw(2)
    drawing = training.renderer(batch.observations)
    made = [
        pixels_of((picture - truth).square(), o.cells, 4).flatten(1).mean(dim=1)
        for picture, truth, o in zip(drawing.pictures, batch.truth, batch.observations, strict=True)
    ]
    right = (torch.cat(made) + LEAST_ERROR).log()
    at_best = training.error_loss(drawing._replace(error=right), batch)
    assert at_best < 1e-12  # the logarithm is rounded
    off = training.error_loss(drawing._replace(error=right + 2), batch)
    torch.testing.assert_close(off, torch.tensor(4 * OPTIONS.error_weight), rtol=1e-5, atol=0)


@pytest.mark.parametrize("frames", [0, 1])
def test_a_step_trains_field_renderer_and_mean(ball_scene: Scene, frames: int) -> None:
    training = new_training(ball_scene, replace(OPTIONS, refined=0.25), frames=frames)
    before = {name: x.clone() for name, x in training.result().items()}
    for _ in range(3):
        training.advance()
    after = training.result()
    changed = {name for name in before if not torch.equal(before[name], after[name])}
    assert {"field.table", "field.layers.density_out", "field.layers.feature_out"} <= changed
    assert {f"outcome.network.{name}.weight" for name in ("leave", "read", "error")} <= changed


def test_the_result_is_the_running_mean_of_the_weights_or_the_weights(ball_scene: Scene) -> None:
    for average in (0.0, 0.999):
        training = new_training(ball_scene, replace(OPTIONS, average=average, clip=None))
        for _ in range(2):
            training.advance()
        pairs = zip(training.outcome.parameters(), training.renderer.parameters(), strict=True)
        assert all(torch.equal(one, other) for one, other in pairs) == (average == 0)


def test_a_long_gradient_is_shortened_before_the_weights_are_changed(
    ball_scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen, update = [], JointTraining.update

    def watched(training: JointTraining) -> None:
        grads = [x.grad for x in training.renderer.parameters() if x.grad is not None]
        seen.append(torch.stack([grad.norm() for grad in grads]).norm().item())
        update(training)

    monkeypatch.setattr(JointTraining, "update", watched)
    for clip in (None, 1e-3):
        new_training(ball_scene, replace(OPTIONS, clip=clip)).advance()
    free, clipped = seen
    assert free > 1e-3
    assert clipped == pytest.approx(1e-3, rel=1e-3)


def test_a_killed_training_ends_as_if_it_had_never_stopped(
    ball_scene: Scene, tmp_path: Path
) -> None:
    """The weights, their mean, and the preceding pictures."""
    options = replace(OPTIONS, refined=0.25, motion=small_motion(pool=2, uses=3, longer=0.5))
    goes_on_after_a_kill(lambda: new_training(ball_scene, options, steps=8), 4, tmp_path)


def test_a_patch_lies_around_content(ball_scene: Scene) -> None:
    """Of a side of 2: the corner of a picture has none."""
    options = replace(OPTIONS, patch=2, motion=replace(MOTION, uses=100))
    source = new_training(ball_scene, options).patches
    patches = [source.cut(source.example()) for _ in range(100)]
    assert not any((patch.truth == 1).all() for patch in patches)
    assert len({(patch.view.low.cx, patch.view.low.cy) for patch in patches}) > 15


def test_content_is_in_the_cells_that_show_more_than_background(ball_scene: Scene) -> None:
    source = new_training(ball_scene).patches
    picture = ball_scene.splits["train"].images[0]
    alpha = picture[..., 3].float().view(8, 4, 8, 4).amax(dim=(1, 3))
    assert torch.equal(source._cells(picture), (alpha > 0).nonzero())
    on_white = torch.where(picture[..., 3:] > 0, picture[..., :3], 255)
    assert torch.equal(source._cells(on_white), (alpha > 0).nonzero())
    assert len(source._cells(torch.full_like(on_white, 255))) == 64


def test_wrong_options_are_named() -> None:
    with pytest.raises(ValueError, match=r"^joint\.average: expected a share of less than 1"):
        lean_joint(average=1.0)
    with pytest.raises(ValueError, match=r"^joint\.clip: expected more than 0, or null, got 0"):
        lean_joint(clip=0.0)


def train(scenes: list[Scene], output: Path, log: Log, channels: int = 3) -> dict[str, Tensor]:
    model = lean_model(channels=channels, step=4.0)
    joint = lean_joint(patch=4, motion=small_motion(pool=2, length=2))
    stage2 = LeanStage2(model, partial(RENDERER, init="scratch"), joint)
    stage2.pretrain(TEACHER, scenes, BUDGET, output, log)
    return load_file(output)


@pytest.mark.slow
def test_the_weights_of_several_scenes_are_what_a_renderer_starts_from(
    ball_scene: Scene, tmp_path: Path, quiet_log: Log, monkeypatch: pytest.MonkeyPatch
) -> None:
    on_black = replace(ball_scene, name="on black", background=torch.zeros(3), digest="on black")
    output = tmp_path / "new folder" / "lean.safetensors"
    written = train([ball_scene, on_black], output, quiet_log)
    assert checkpoint.read(output)[1] == {"scenes": 2, "steps": BUDGET.renderer_steps}
    assert {weight.dtype for weight in written.values()} == {torch.float16}
    log = ConsoleLog(tmp_path / "again", quiet=True)  # where nothing is found again
    again = train([ball_scene, on_black], tmp_path / "again.safetensors", log)
    assert all(torch.equal(weight, again[name]) for name, weight in written.items())
    for name in ("enter.weight", "leave.weight", "read.weight", "read.bias"):
        assert written[name].isfinite().all(), name
        assert written[name].any(), name  # the last three were 0 before the training
    monkeypatch.setattr(renderers, "PRETRAINED", output)
    for channels, frames in ((3, 1), (6, 1), (3, 0), (4, 0)):
        started = RENDERER(channels, frames, 4)
        assert torch.equal(started.network.trunk[0].spread, written["trunk.0.spread"].float())


def test_features_that_mean_something_else_in_every_scene_are_refused(
    ball_scene: Scene, tmp_path: Path, quiet_log: Log
) -> None:
    with pytest.raises(SteerbenchError, match=r"channels \(K\) of 3, got 4"):
        train([ball_scene], tmp_path / "lean.safetensors", quiet_log, channels=4)
    assert not list(tmp_path.rglob("*.safetensors"))  # nothing was trained before


def test_a_renderer_that_was_trained_on_the_same_scenes_is_found_again(
    ball_scene: Scene, tmp_path: Path, quiet_log: Log, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = train([ball_scene], tmp_path / "first.safetensors", quiet_log)
    monkeypatch.delattr(JointTraining, "advance")
    again = train([ball_scene], tmp_path / "again.safetensors", quiet_log)
    for name, weight in first.items():
        assert torch.equal(again[name], weight), name
    with pytest.raises(AttributeError, match="advance"):  # with other scenes, another training
        train([ball_scene, ball_scene], tmp_path / "other.safetensors", quiet_log)


class Source:
    """Patches of which all that is known is the source they are from."""

    def __init__(self, number: int, generator: torch.Generator) -> None:
        self.number, self.options, self.generator = number, OPTIONS, generator

    def draw(self, count: int) -> Batch:
        return Batch([], [], torch.full((count,), self.number), torch.zeros(0))


def test_a_batch_is_of_one_source_and_every_source_has_its_turn() -> None:
    def drawn(seed: int) -> list[int]:
        generator = torch.Generator().manual_seed(seed)
        patches = AnyOf([Source(number, generator) for number in range(3)])
        batches = [patches.draw(2).truth.tolist() for _ in range(300)]
        assert all(first == second for first, second in batches)
        return [first for first, _ in batches]

    numbers = drawn(0)
    for number in range(3):
        assert numbers.count(number) == pytest.approx(100, abs=41)  # 5 standard deviations
    assert numbers == drawn(0) != drawn(1)

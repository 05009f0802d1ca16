"""Stage 2: train a 2D renderer and the field for one model, or load the result if it exists."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any, ClassVar

import torch

from bench.provenance import digest, libraries
from bench.types import Budget, Log, Scene, SteerbenchError
from methods.instant_ngp.stage1 import Setup, TrainedField
from methods.steernerf.options import EVERYWHERE, Model, Rendering, Skips
from methods.steernerf.pipeline import Pipeline
from methods.steernerf.renderer import Renderer2d
from methods.steernerf.training.distillation import distilled_views
from methods.steernerf.training.examples import ExamplePool, TrainingViews
from methods.steernerf.training.joint import JointTraining
from methods.steernerf.training.options import JointOptions
from methods.steernerf.training.patches import Patches
from methods.training import loop

MARKS = (0.125, 0.25, 0.5)
"""Shares of the steps after which the weights are saved as well, so that an ablation can be shown
as a curve over the steps."""


@dataclass(frozen=True)
class Stage2:
    """What is trained in stage 2, and how.

    A variant of the method overrides `make`, `rendering`, and the classes of the pipeline, of its
    patches and of the training.
    """

    model: Model  # the settings it is trained for
    renderer: Callable[..., Renderer2d]  # factory of the 2D renderer
    joint: JointOptions  # how it is trained
    after: float = 1.0  # share of the steps whose weights are used, 1 or one of `MARKS`

    pipeline: ClassVar[type[Pipeline]] = Pipeline
    patches: ClassVar[type[Patches]] = Patches
    training: ClassVar[type[JointTraining]] = JointTraining

    def __post_init__(self) -> None:
        if self.after not in (*MARKS, 1):
            choices = ", ".join(map(str, MARKS))
            raise ValueError(f"after: expected {choices} or 1, got {self.after}")

    def make(self) -> Renderer2d:
        """Make an untrained 2D renderer."""
        return self.renderer(self.model.channels, self.model.frames, self.model.scale)

    @property
    def rendering(self) -> Any:
        """How frames are rendered in training: everywhere, so that one training serves all
        choices."""
        skips = Skips(empty=True, hidden=True)
        return Rendering(self.model.step, self.model.stop, EVERYWHERE, skips)

    def key(self, budget: Budget) -> dict[str, object]:
        """Everything that the training depends on, besides the field of stage 1."""
        make: Any = self.renderer
        kind, settings = (make.func, make.keywords) if isinstance(make, partial) else (make, {})
        return {
            "renderer_steps": budget.renderer_steps,
            "model": asdict(self.model),
            "renderer": {"kind": f"{kind.__module__}.{kind.__qualname__}", **settings},
            "joint": asdict(self.joint),
            "stage2": digest(type(self), kind),
            "stage2_libraries": libraries(type(self), kind),
        }

    def new_renderer(self, setup: Setup) -> Renderer2d:
        """Make the untrained 2D renderer of the seed and the device of `setup`."""
        torch.manual_seed(setup.seed)
        made = self.make().to(setup.device)
        return made.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def patches_of(
        self, pipeline: Pipeline, views: TrainingViews, learning: bool, generator: torch.Generator
    ) -> Patches:
        """Patches of `views` that `pipeline` renders; its field learns from them if `learning`."""
        pool = ExamplePool(pipeline, self.rendering, views, self.joint.motion, generator)
        return self.patches(pool, self.joint, learning, generator)


@dataclass(frozen=True)
class TrainedPipeline:
    """A trained `pipeline`, the `key` of its weights, and the seconds of stage 2 spent on them."""

    pipeline: Pipeline
    key: dict[str, object]
    train_s: float


def train_stage2(
    trained: TrainedField, setup: Setup, stage2: Stage2, scene: Scene, budget: Budget, log: Log
) -> TrainedPipeline:
    """Train `stage2` on the field that `setup` made for `scene`, or load the result of the same
    training. The field is widened to K features and changed in place."""
    model, joint, steps = stage2.model, stage2.joint, budget.renderer_steps
    key = {**setup.key(scene, budget), **stage2.key(budget)}
    folder = log.stage_dir("steernerf", key)
    finished = folder / "steernerf.safetensors"
    count = 0 if finished.exists() else joint.distilled(steps, model.frames)
    distilled, distilled_s = distilled_views(setup, trained, scene, budget, count, log)
    random = torch.Generator().manual_seed(setup.seed) if joint.features == "random" else None
    trained.field.widen(model.channels, random)

    renderer, learning = stage2.new_renderer(setup), joint.field == "joint"
    background = scene.background.to(setup.device)
    pipeline = stage2.pipeline(trained.field, trained.occupancy, background, renderer, model)
    views = TrainingViews.of(scene, distilled, joint.distilled_share)
    generator = torch.Generator().manual_seed(setup.seed)
    patches = stage2.patches_of(pipeline, views, learning, generator)
    learned = trained if learning else None
    training = stage2.training(renderer, patches, joint, steps, generator, learned)
    pipeline.renderer, training.seconds = training.outcome, distilled_s

    marks = {share: folder / f"after-{share}.safetensors" for share in MARKS}
    at = {mark: math.ceil(share * steps) for share, mark in marks.items()}
    loop.train(training, finished, "training the 2D renderer", log, at)
    if stage2.after < 1:
        mark = marks[stage2.after]
        if not mark.exists():
            raise SteerbenchError(f"{mark} is missing: remove {folder} to train again")
        loop.load(training, mark)
        key["after"] = stage2.after
    trained.field.requires_grad_(False).gradients = None
    pipeline.renderer.requires_grad_(False)
    return TrainedPipeline(pipeline, key, training.seconds)

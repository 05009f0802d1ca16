"""Stage 2: train a 2D renderer and the field for one model, or load the result if it exists."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from bench.sources import digest, libraries
from bench.types import Budget, Log, Scene, SteerbenchError
from methods.instant_ngp.stage1 import Setup, TrainedField
from methods.steernerf.options import Model, Rendering
from methods.steernerf.pipeline import Pipeline
from methods.steernerf.renderer import Renderer2d
from methods.steernerf.training.distillation import distilled_views
from methods.steernerf.training.joint import JointTraining, RendererTraining
from methods.steernerf.training.options import JointOptions
from methods.steernerf.training.patches import PatchSource
from methods.steernerf.training.sequences import SequencePool, TrainingViews
from methods.training import loop

MARKS = (0.125, 0.25, 0.5)
"""Shares of the steps after which the weights are saved as well, so that an ablation can be shown
as a curve over the steps."""


@dataclass(frozen=True)
class Stage2:
    """What is trained in stage 2, and how.

    Attributes:
        model: the settings it is trained for.
        make_renderer: factory of the 2D renderer, called with K, L and s.
        joint: how it is trained.
        after: share of the steps whose weights are used, 1 or one of `MARKS`; one training serves
            all of them.
    """

    model: Model
    make_renderer: Callable[..., Renderer2d]
    joint: JointOptions
    after: float = 1.0

    def __post_init__(self) -> None:
        if self.after not in (*MARKS, 1):
            choices = ", ".join(map(str, MARKS))
            raise ValueError(f"after: expected {choices} or 1, got {self.after}")

    def new_renderer(self, seed: int, device: torch.device) -> Renderer2d:
        """Make an untrained 2D renderer."""
        torch.manual_seed(seed)
        model = self.model
        renderer = self.make_renderer(model.channels, model.frames, model.scale).to(device)
        return renderer.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def key(self, budget: Budget) -> dict[str, object]:
        """Everything that the training depends on, besides the field of stage 1."""
        make: Any = self.make_renderer
        kind, settings = (make.func, make.keywords) if isinstance(make, partial) else (make, {})
        return {
            "renderer_steps": budget.renderer_steps,
            "model": asdict(self.model),
            "renderer": {"kind": f"{kind.__module__}.{kind.__qualname__}", **settings},
            "joint": asdict(self.joint),
            "stage2": digest(train_stage2, kind),
            "stage2_libraries": libraries(train_stage2, kind),
        }


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
    model, joint = stage2.model, stage2.joint
    key = {**setup.key(scene, budget), **stage2.key(budget)}
    folder = log.stage_dir("steernerf", key)
    finished = folder / "steernerf.safetensors"
    count = 0 if finished.exists() else joint.distilled(budget.renderer_steps, model.frames)
    distilled, distilled_s = distilled_views(setup, trained, scene, budget, count, log)
    random = torch.Generator().manual_seed(setup.seed) if joint.features == "random" else None
    trained.field.widen(model.channels, random)
    views = TrainingViews.of(scene, distilled, joint.distilled_share)
    background = scene.background.to(setup.device)
    pipeline, training = _prepared(trained, background, stage2, views, budget, setup.seed)
    training.seconds = distilled_s
    marks = {_at(folder, share): math.ceil(share * training.steps) for share in MARKS}
    loop.train(training, finished, "training the 2D renderer", log, marks)
    if stage2.after < 1:
        mark = _at(folder, stage2.after)
        if not mark.exists():
            raise SteerbenchError(f"{mark} is missing: remove {folder} to train again")
        loop.load(training, mark)
        key["after"] = stage2.after
    trained.field.requires_grad_(False).gradients = None
    pipeline.renderer.requires_grad_(False)
    return TrainedPipeline(pipeline, key, training.seconds)


def _at(folder: Path, share: float) -> Path:
    """The file of the weights after a `share` of the steps."""
    return folder / f"after-{share}.safetensors"


def _prepared(
    trained: TrainedField,
    background: Tensor,
    stage2: Stage2,
    views: TrainingViews,
    budget: Budget,
    seed: int,
) -> tuple[Pipeline, RendererTraining]:
    model, joint, field = stage2.model, stage2.joint, trained.field
    renderer = stage2.new_renderer(seed, field.device)
    pipeline = Pipeline(field, trained.occupancy, background, renderer, model)
    generator = torch.Generator().manual_seed(seed)
    rendering = Rendering.in_training(model, joint.refined, joint.refined_step)
    pool = SequencePool(pipeline, rendering, views, joint.motion, generator)
    learning = joint.field == "joint"
    through = joint.through if learning else "none"
    patches = PatchSource(pool, joint, through, generator)
    rest = renderer, patches, joint, budget.renderer_steps, generator
    training = JointTraining(trained, *rest) if learning else RendererTraining(*rest)
    pipeline.renderer = training.mean
    return pipeline, training

"""Pre-training of the lean 2D renderer: initial weights, learned on the fields of many scenes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from bench.errors import explained
from bench.sources import digest
from bench.types import Budget, Log, Scene, SteerbenchError
from methods.instant_ngp.stage1 import Setup, train_field
from methods.steernerf.options import Rendering
from methods.steernerf.pipeline import Pipeline
from methods.steernerf.training.joint import RendererTraining
from methods.steernerf.training.patches import Batch, Patches, PatchSource
from methods.steernerf.training.sequences import SequencePool, TrainingViews
from methods.steernerf.training.stage2 import Stage2
from methods.training import checkpoint, loop


@dataclass(frozen=True)
class AnyOf:
    """Draws each batch of patches from one of `sources`, which `generator` chooses."""

    sources: Sequence[Patches]
    generator: torch.Generator

    def draw(self, count: int) -> Batch:
        """See `training.patches.Patches`."""
        place = int(torch.randint(len(self.sources), (), generator=self.generator))
        return self.sources[place].draw(count)

    def state(self) -> dict[str, Tensor]:
        """See `training.patches.Patches`."""
        states = (source.state() for source in self.sources)
        return {f"{n}.{name}": x for n, state in enumerate(states) for name, x in state.items()}

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """See `training.patches.Patches`."""
        for number, source in enumerate(self.sources):
            source.restore(checkpoint.part(tensors, f"{number}."))


def pretrain_renderer(
    setup: Setup, stage2: Stage2, scenes: Sequence[Scene], budget: Budget, output: Path, log: Log
) -> None:
    """Fit a field to each of `scenes`, train one renderer on all of them, write it to `output`.

    Trained stages are cached. The fields are frozen: what a renderer learns from them must hold for
    fields it has never seen.

    Raises:
        SteerbenchError: K is not 3. Further features mean something different in every scene.
    """
    model, joint = stage2.model, stage2.joint
    if model.channels != 3:
        raise SteerbenchError(
            f"a renderer for many scenes reads colours alone: expected channels (K) of 3, got "
            f"{model.channels}"
        )
    with explained(output.parent):
        output.parent.mkdir(parents=True, exist_ok=True)
    renderer = stage2.new_renderer(setup.seed, setup.device)
    generator = torch.Generator().manual_seed(setup.seed)
    sources, pipelines = [], []
    for number, scene in enumerate(scenes, 1):
        log.info(f"scene {number} of {len(scenes)}: {scene.name}")
        trained = train_field(setup, scene, budget, log)
        background = scene.background.to(setup.device)
        pipeline = Pipeline(trained.field, trained.occupancy, background, renderer, model)
        rendering = Rendering.in_training(model, joint.refined, joint.refined_step)
        views = TrainingViews.of(scene)
        pool = SequencePool(pipeline, rendering, views, joint.motion, generator)
        sources.append(PatchSource(pool, joint, "none", generator))
        pipelines.append(pipeline)
    patches = AnyOf(sources, generator)
    training = RendererTraining(renderer, patches, joint, budget.renderer_steps, generator)
    for pipeline in pipelines:
        pipeline.renderer = training.mean
    fields = [setup.key(scene, budget) for scene in scenes]
    key = {"fields": fields, "code": digest(pretrain_renderer), **stage2.key(budget)}
    finished = log.stage_dir("pretrained", key) / "renderer.safetensors"
    loop.train(training, finished, "training a renderer for many scenes", log)
    halves = {name: x.half() for name, x in training.mean.network.state_dict().items()}
    checkpoint.write(output, halves, {"scenes": len(scenes), "steps": training.steps})
    log.info(f"written: {output}")

"""Pre-training of the lean 2D renderer: initial weights, learned on the fields of many scenes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor

from bench.errors import explained
from bench.provenance import digest
from bench.types import Budget, Log, Scene, SteerbenchError
from methods.instant_ngp.stage1 import Setup, train_field
from methods.steernerf.training.examples import TrainingViews
from methods.steernerf.training.patches import Batch, Patches
from methods.steernerf_lean.training import LeanStage2
from methods.training import checkpoint, loop


class AnyOf(Patches):
    """Draws each batch of patches from one of `sources`, which `generator` chooses."""

    def __init__(self, sources: Sequence[Patches], generator: torch.Generator) -> None:
        self.sources, self.generator = sources, generator

    def draw(self, count: int) -> Batch:
        """Draw `count` patches, all from the same source."""
        place = int(torch.randint(len(self.sources), (), generator=self.generator))
        return self.sources[place].draw(count)

    def state(self) -> dict[str, Tensor]:
        """What the next patches of all sources depend on."""
        states = (source.state() for source in self.sources)
        return {f"{n}.{name}": x for n, state in enumerate(states) for name, x in state.items()}

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Restore what `state` returned."""
        for number, source in enumerate(self.sources):
            source.restore(checkpoint.part(tensors, f"{number}."))


def pretrain_renderer(
    setup: Setup,
    stage2: LeanStage2,
    scenes: Sequence[Scene],
    budget: Budget,
    output: Path,
    log: Log,
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
    renderer = stage2.new_renderer(setup)
    generator = torch.Generator().manual_seed(setup.seed)
    sources = []
    for number, scene in enumerate(scenes, 1):
        log.info(f"scene {number} of {len(scenes)}: {scene.name}")
        trained = train_field(setup, scene, budget, log)
        background = scene.background.to(setup.device)
        pipeline = stage2.pipeline(trained.field, trained.occupancy, background, renderer, model)
        views = TrainingViews.of(scene)
        sources.append(stage2.patches_of(pipeline, views, learning=False, generator=generator))
    patches = AnyOf(sources, generator)
    training = stage2.training(renderer, patches, joint, budget.renderer_steps, generator)
    for source in sources:
        source.pipeline.renderer = training.outcome
    fields = [setup.key(scene, budget) for scene in scenes]
    key = {"fields": fields, "code": digest(pretrain_renderer), **stage2.key(budget)}
    finished = log.stage_dir("pretrained", key) / "renderer.safetensors"
    loop.train(training, finished, "training a renderer for many scenes", log)
    halves = {name: x.half() for name, x in training.outcome.network.state_dict().items()}
    checkpoint.write(output, halves, {"scenes": len(scenes), "steps": training.steps})
    log.info(f"written: {output}")

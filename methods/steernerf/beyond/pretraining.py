"""A 2D renderer for any scene: trained once, on the fields of many, to start every scene from."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from bench.errors import explained
from bench.motion import viewing_target
from bench.types import Budget, Log, Scene, SteerbenchError
from methods.instant_ngp.stage1 import Setup, pretrain
from methods.steernerf.options import PipelineOptions
from methods.steernerf.pipeline import Pipeline
from methods.steernerf.renderer import Renderer2d
from methods.steernerf.training.joint import JointOptions, RendererTraining
from methods.steernerf.training.patches import Batch, Patches, PatchSource
from methods.steernerf.training.sequences import SequencePool, true_views
from methods.training import checkpoint, loop


@dataclass(frozen=True)
class AnyOf:
    """The patches of a batch come from one of `sources`, drawn by `generator`."""

    sources: Sequence[Patches]
    generator: torch.Generator

    def draw(self, count: int) -> Batch:
        """See `methods.steernerf.training.patches.Patches`."""
        place = int(torch.randint(len(self.sources), (), generator=self.generator))
        return self.sources[place].draw(count)

    def state(self) -> dict[str, Tensor]:
        """See `methods.steernerf.training.patches.Patches`."""
        states = (source.state() for source in self.sources)
        return {f"{n}.{name}": x for n, state in enumerate(states) for name, x in state.items()}

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """See `methods.steernerf.training.patches.Patches`."""
        for number, source in enumerate(self.sources):
            source.restore(checkpoint.part(tensors, f"{number}."))


def train_generic(
    setup: Setup,
    options: PipelineOptions,
    make_renderer: Callable[..., Renderer2d],
    joint: JointOptions,
    scenes: Sequence[Scene],
    budget: Budget,
    folder: Path,
    output: Path,
    log: Log,
) -> None:
    """Fit a field to each of `scenes`, train one renderer on all of them, write it to `output`.

    What was trained stays in `folder`, and is found there again. The fields are frozen: what a
    renderer learns from them must hold for fields it never saw.

    Raises:
        SteerbenchError: K is not 3. Other features mean something else in every scene.
    """
    if options.channels != 3:
        raise SteerbenchError(
            f"a generic renderer knows colours alone: expected channels (K) of 3, got "
            f"{options.channels}"
        )
    with explained(output.parent):
        output.parent.mkdir(parents=True, exist_ok=True)
    torch.manual_seed(setup.seed)
    generator = torch.Generator().manual_seed(setup.seed)
    renderer = make_renderer(options.channels, options.frames, options.scale)
    renderer = renderer.to(setup.device).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    sources, pipelines = [], []
    for number, scene in enumerate(scenes, 1):
        log.info(f"scene {number} of {len(scenes)}: {scene.name}")
        trained = pretrain(setup, scene, budget, log)
        background = scene.background.to(setup.device)
        everywhere = options.taught(joint.refined)
        pipeline = Pipeline(trained.field, trained.occupancy, background, renderer, everywhere)
        views, target = true_views(scene), viewing_target(scene)
        pool = SequencePool(pipeline, views, [], 0.0, target, joint.motion, generator)
        sources.append(PatchSource(pipeline, pool, joint.patch, False, "present", generator))
        pipelines.append(pipeline)
    patches = AnyOf(sources, generator)
    training = RendererTraining(renderer, patches, joint, budget.renderer_steps, generator)
    for pipeline in pipelines:
        pipeline.renderer = training.mean
    loop.train(training, folder / "generic.safetensors", "training a generic renderer", log)
    halves = {name: x.half() for name, x in training.mean.network.state_dict().items()}
    checkpoint.write(output, halves, {"scenes": len(scenes), "steps": training.steps})
    log.info(f"written: {output}")

"""Stage 2 of the lean SteerNeRF: the steps in which it differs from the paper's, and how the 2D
renderer gets its initial weights, on the fields of many scenes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from bench.errors import explained
from bench.types import Budget, Log, NullProbe, Rays, Scene, Split, SteerbenchError
from methods.instant_ngp.stage1 import Setup, train_field
from methods.kernels.dispatch import refuse_gpu
from methods.rendering.batch import render_batch
from methods.rendering.compaction import compacts, indices_where
from methods.steernerf.patches import Batch, Example, Patch, Patches
from methods.steernerf.stage2 import JointTraining, Stage2
from methods.steernerf.unet import Observation, Renderer2d
from methods.steernerf_lean.cells import pixels_of
from methods.steernerf_lean.lean_renderer import Drawing
from methods.steernerf_lean.observation import LeanObservation
from methods.steernerf_lean.options import LeanJointOptions, LeanRendering
from methods.steernerf_lean.pipeline import LeanPipeline, rays_of_cells, worst_cells
from methods.training import checkpoint, loop

LEAST_ERROR = 1e-6  # added to that of a cell: below this, one mean squared error is like another


class LeanPatches(Patches):
    """Patches around content; the field learns from the present frame alone."""

    pipeline: LeanPipeline
    rendering: LeanRendering

    def __init__(self, *given: Any) -> None:
        super().__init__(*given)
        self._content: dict[int, Tensor] = {}  # by the number of the view

    def place(self, example: Example, side: int, size: tuple[int, int]) -> Sequence[int]:
        """Choose the first row and column of a patch that shows more than background."""
        if example.number not in self._content:
            self._content[example.number] = self._cells(self.pictures[example.number])
        cells = self._content[example.number]
        chosen = cells[self.random(len(cells))].tolist()
        return [
            min(max(centre - self.random(side), 0), extent - side)
            for centre, extent in zip(chosen, size, strict=True)
        ]

    def _cells(self, picture: Tensor) -> Tensor:
        """Row and column [N, 2] of the cells of `picture`, uint8 [H, W, 3 or 4], that show more
        than background; of all if none does."""
        scale = self.pipeline.model.scale
        if picture.shape[-1] == 4:
            content = picture[..., 3] > 0
        else:
            background = (self.pipeline.background[:3] * 255).round().to(picture)
            content = (picture != background).any(dim=-1)
        height, width = (-(-side // scale) for side in content.shape)
        rows, columns = content.nonzero().unbind(dim=1)
        cells = torch.zeros(height, width, dtype=torch.bool)
        cells[rows // scale, columns // scale] = True
        return cells.nonzero() if cells.any() else (~cells).nonzero()

    def observations(
        self, patches: Sequence[Patch], shown: Sequence[Observation]
    ) -> Sequence[LeanObservation]:
        """What the 2D renderer is shown of `patches`; the host waits once for the cells of all."""
        pipeline, how, probe = self.pipeline, self.rendering, NullProbe()
        near = indices_where([pipeline.near(o.frame, how).flatten() for o in shown])
        return [
            pipeline.observe(o.frame, patch.example.buffer, patch.view, how, probe, cells)
            for patch, o, cells in zip(patches, shown, near, strict=True)
        ]


class LeanTraining(JointTraining):
    """Stage 2 with two further losses: of the estimated error, and of the refined cells. The result
    is the running mean of the renderer's weights."""

    options: LeanJointOptions
    patches: LeanPatches

    def __init__(self, renderer: Renderer2d, *rest: Any) -> None:
        super().__init__(renderer, *rest)
        self.outcome = deepcopy(renderer)

    def judge(self, drawn: Drawing, batch: Batch) -> tuple[Tensor, Tensor | float]:
        """The pictures that the renderer has `drawn`, and the loss besides their squared error."""
        _, more = super().judge(drawn, batch)
        more += self.error_loss(drawn, batch) + self.refinement_loss(drawn, batch)
        return drawn.pictures, more

    def error_loss(self, drawn: Drawing, batch: Batch) -> Tensor:
        """How far the renderer's estimated errors are from its actual errors."""
        errors = (drawn.pictures.detach() - batch.truth).square().mean(dim=-1)
        made = [
            pixels_of(error, o.cells, view.scale).mean(dim=1)
            for error, o, view in zip(errors, batch.observations, batch.views, strict=True)
        ]
        wanted = (torch.cat(made) + LEAST_ERROR).log()
        return self.options.error_weight * functional.mse_loss(drawn.error, wanted)

    def refinement_loss(self, drawn: Drawing, batch: Batch) -> Tensor | float:
        """Squared error of rays through the refined cells, estimated from `refined_rays` of them
        and scaled to the batch: it keeps the field accurate at full resolution."""
        if not (self.trained and self.options.refined):
            return 0.0
        pipeline, rays, truth = self.patches.pipeline, [], []
        errors = drawn.error.detach().split([len(o.cells) for o in batch.observations])
        for o, view, picture, error in zip(
            batch.observations, batch.views, batch.truth, errors, strict=True
        ):
            worst = o.cells[worst_cells(error, self.options.refined)]
            rays.append(rays_of_cells(worst, view))
            truth.append(pixels_of(picture, worst, view.scale).flatten(0, 1))
        wanted, every = torch.cat(truth), Rays.joined(rays)
        if not len(wanted):
            return 0.0
        some = torch.randperm(len(wanted), generator=self.generator)[: self.options.refined_rays]
        some = some.to(wanted.device, non_blocking=True)
        pixels, _ = render_batch(
            self.trained.field,
            every.take(some),
            pipeline.occupancy,
            self.patches.rendering.refined_sampling,
            background=pipeline.background,
            hidden=not compacts(wanted.device),
        )
        error = (pixels.values[:, :3] - wanted[some]).square().sum() / len(some)
        return error * len(wanted) / batch.truth.numel()

    def update(self) -> None:
        """Update the weights and their mean, after clipping the gradient."""
        if self.options.clip is not None:
            nn.utils.clip_grad_norm_(self.renderer.parameters(), self.options.clip)
        super().update()
        # At first over fewer steps: the earliest weights are not worth keeping, the first not at
        # all. (torch's AveragedModel would make the host wait for a GPU.)
        early = (1 + self.step) / (10 + self.step) if self.step else 0.0
        mean, new = ([p.data for p in x.parameters()] for x in (self.outcome, self.renderer))
        torch._foreach_lerp_(mean, new, 1 - min(self.options.average, early))

    def state(self) -> tuple[dict[str, Tensor], dict[str, float]]:
        """Also the weights themselves."""
        tensors, figures = super().state()
        return tensors | self.renderer.state_dict(prefix="learning."), figures

    def restore(self, tensors: Mapping[str, Tensor], figures: Mapping[str, float]) -> None:
        """Restore what `result` and `state` returned."""
        super().restore(tensors, figures)
        self.renderer.load_state_dict(checkpoint.part(tensors, "learning."))


class AnyOf(Patches):
    """Draws each batch of patches from one of `sources`, which their `generator` chooses."""

    def __init__(self, sources: Sequence[Patches]) -> None:
        self.sources = sources
        self.options, self.generator = sources[0].options, sources[0].generator

    def draw(self, count: int) -> Batch:
        """Draw `count` patches, all from the same source."""
        return self.sources[self.random(len(self.sources))].draw(count)

    def state(self) -> dict[str, Tensor]:
        """What the next patches of all sources depend on."""
        states = (source.state() for source in self.sources)
        return {f"{n}.{name}": x for n, state in enumerate(states) for name, x in state.items()}

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Restore what `state` returned."""
        for number, source in enumerate(self.sources):
            source.restore(checkpoint.part(tensors, f"{number}."))


class LeanStage2(Stage2):
    """What is trained in stage 2 of the lean SteerNeRF, and how."""

    joint: LeanJointOptions
    pipeline, patches, training = LeanPipeline, LeanPatches, LeanTraining

    def make(self, setup: Setup) -> Renderer2d:
        """As of `Stage2`; raises Unavailable for backend "gpu"."""
        refuse_gpu(setup.backend, "steernerf_lean")
        return super().make(setup)

    def pretrain(
        self, setup: Setup, scenes: Sequence[Scene], budget: Budget, output: Path, log: Log
    ) -> None:
        """Fit a field to each of `scenes`, train one renderer on all of them, write it to `output`.

        The fields are frozen: what a renderer learns must hold for fields it has never seen. Raises
        SteerbenchError unless K is 3: further features mean something different in every scene.
        """
        joint, channels = replace(self.joint, field="frozen"), self.model.channels
        if channels != 3:
            wanted = "a renderer for many scenes reads colours alone: expected channels (K) of 3"
            raise SteerbenchError(f"{wanted}, got {channels}")
        with explained(output.parent):
            output.parent.mkdir(parents=True, exist_ok=True)
        renderer, generator = self.make(setup), torch.Generator().manual_seed(setup.seed)
        sources = []
        for number, scene in enumerate(scenes, 1):
            log.info(f"scene {number} of {len(scenes)}: {scene.name}")
            trained = train_field(setup, scene, budget, log)
            pipeline = self.pipeline(trained, scene.background, renderer, self.model)
            sources.append(self.patches(pipeline, scene, Split([], [], []), joint, generator))
        training = self.training(renderer, AnyOf(sources), budget.renderer_steps, None)
        for source in sources:
            source.pipeline.renderer = training.outcome
        key = {"fields": [setup.key(scene, budget) for scene in scenes], **self.key(budget)}
        finished = log.stage_dir("pretrained", key) / "renderer.safetensors"
        loop.train(training, finished, "training a renderer for many scenes", log)
        halves = {name: x.half() for name, x in training.outcome.network.state_dict().items()}
        checkpoint.write(output, halves, {"scenes": len(scenes), "steps": training.steps})
        log.info(f"written: {output}")

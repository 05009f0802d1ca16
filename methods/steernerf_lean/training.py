"""Stage 2 of the lean SteerNeRF: the steps in which it differs from the paper's."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import deepcopy
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from bench.types import NullProbe, Rays
from methods.rendering.batch import render_batch
from methods.rendering.compaction import compacts, indices_where
from methods.steernerf.options import EVERYWHERE
from methods.steernerf.renderer import Points, Renderer2d
from methods.steernerf.training.examples import Example
from methods.steernerf.training.joint import JointTraining
from methods.steernerf.training.patches import Batch, Patch, Patches, Shown
from methods.steernerf.training.stage2 import Stage2
from methods.steernerf.view import View
from methods.steernerf_lean.cells import pixels_of
from methods.steernerf_lean.observation import Drawing, LeanObservation
from methods.steernerf_lean.options import LeanJointOptions, LeanRendering, LeanSkips
from methods.steernerf_lean.pipeline import LeanPipeline
from methods.steernerf_lean.refinement import rays_of_cells, worst_cells
from methods.training import checkpoint

LEAST_ERROR = 1e-6
"""Added to the mean squared error of a cell: below this, one error is as good as another."""


class LeanPatches(Patches):
    """Patches around content; the field learns from the present frame alone."""

    pipeline: LeanPipeline

    def __init__(self, *given: Any) -> None:
        super().__init__(*given)
        self._content: dict[int, Tensor] = {}  # by the number of the view

    def place(
        self, example: Example, extents: tuple[int, int], size: tuple[int, int]
    ) -> Sequence[int]:
        """Choose the first row and column of a patch that shows more than background."""
        if example.number not in self._content:
            self._content[example.number] = self._cells(self.pool.views.pictures[example.number])
        cells = self._content[example.number]
        chosen = cells[self.random(len(cells))].tolist()
        return [
            min(max(centre - self.random(extent), 0), side - extent)
            for centre, extent, side in zip(chosen, extents, size, strict=True)
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

    def points(self, example: Example, view: View) -> Sequence[Points]:
        """None: the 2D renderer is shown no features of preceding frames."""
        return ()

    def observations(
        self, patches: Sequence[Patch], shown: Sequence[Shown]
    ) -> Sequence[LeanObservation]:
        """What the 2D renderer is shown of `patches`; the host waits once for the cells of all."""
        pipeline, how, probe = self.pipeline, self.rendering, NullProbe()
        near = indices_where([pipeline.near(frame, how).flatten() for frame, _ in shown])
        return [
            pipeline.observe(frame, patch.example.buffer, patch.view, how, probe, cells)
            for patch, (frame, _), cells in zip(patches, shown, near, strict=True)
        ]


class LeanTraining(JointTraining):
    """Stage 2 with two further losses: of the estimated error, and of the refined cells. The result
    is the running mean of the renderer's weights."""

    options: LeanJointOptions

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
        pipeline, rendering, rays, truth = self.patches.pipeline, self.patches.rendering, [], []
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
            rendering.refined_sampling,
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
        self._average()

    @torch.no_grad()
    def _average(self) -> None:
        # At first over fewer steps: the earliest weights are not worth keeping, the first not at
        # all. (torch's AveragedModel would make the host wait for a GPU.)
        early = (1 + self.step) / (10 + self.step) if self.step else 0.0
        mean: list[Tensor] = list(self.outcome.parameters())
        new: list[Tensor] = list(self.renderer.parameters())
        torch._foreach_lerp_(mean, new, 1 - min(self.options.average, early))

    def state(self) -> tuple[dict[str, Tensor], dict[str, float]]:
        """Also the weights themselves."""
        tensors, figures = super().state()
        learning = {f"learning.{name}": x for name, x in self.renderer.state_dict().items()}
        return tensors | learning, figures

    def restore(self, tensors: Mapping[str, Tensor], figures: Mapping[str, float]) -> None:
        """Restore what `result` and `state` returned."""
        super().restore(tensors, figures)
        self.renderer.load_state_dict(checkpoint.part(tensors, "learning."))


class LeanStage2(Stage2):
    """What is trained in stage 2 of the lean SteerNeRF, and how."""

    joint: LeanJointOptions
    pipeline, patches, training = LeanPipeline, LeanPatches, LeanTraining

    def make(self) -> Renderer2d:
        """Make an untrained 2D renderer; it reads the preceding picture if L = 1."""
        model = self.model
        return self.renderer(model.channels, model.scale, history=model.frames > 0)

    @property
    def rendering(self) -> LeanRendering:
        """How frames are rendered during training: everywhere, and refined as `joint` says."""
        model, joint = self.model, self.joint
        return LeanRendering(
            model.step,
            model.stop,
            EVERYWHERE,
            LeanSkips(empty=True, hidden=True, background=True),
            overlap=0.0,
            refined=joint.refined,
            refined_step=joint.refined_step,
        )

"""Stage 2: the 2D renderer and the field, trained together on patches (Section 3.4)."""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from functools import cached_property

import torch
from torch import Tensor, nn
from torch.nn import functional

from bench.types import Rays
from methods.instant_ngp.optimiser import FieldOptimiser
from methods.instant_ngp.stage1 import TrainedField
from methods.instant_ngp.training import restore_field
from methods.kernels import multiplies_bf16
from methods.rendering.batch import opacity_entropy, render_batch
from methods.rendering.compaction import compacts
from methods.rendering.occupancy import EVERY
from methods.steernerf.renderer import Drawing, Renderer2d
from methods.steernerf.training.options import JointOptions
from methods.steernerf.training.patches import Batch, Patches, PatchSource
from methods.steernerf_lean.cells import pixels_of
from methods.steernerf_lean.refinement import rays_of_cells, worst_cells
from methods.training import checkpoint, loop
from methods.training.optimiser import cosine, step_at

LEAST_ERROR = 1e-6
"""Added to the mean squared error of a cell: below this, one error is as good as another."""


class RendererTraining:
    """Stage 2 of the 2D renderer alone, as a `loop.Training`; the field is frozen.

    Args:
        renderer: trained in place.
        patches: source of the patches it learns from.
        steps: number of optimiser steps.
        generator: source of all random numbers, including those of `patches`.

    Attributes:
        mean: the running mean of the renderer's weights, which is the result.
    """

    advice = "Try smaller learning rates (method.joint.rate, method.joint.field_rate)."
    asked: loop.Asked | None = None

    def __init__(
        self,
        renderer: Renderer2d,
        patches: Patches,
        options: JointOptions,
        steps: int,
        generator: torch.Generator,
    ) -> None:
        self.renderer, self.patches, self.options = renderer, patches, options
        self.generator = generator
        self.step, self.steps, self.seconds = 0, steps, 0.0
        self.mean = deepcopy(renderer)

    @cached_property
    def optimiser(self) -> torch.optim.Adam:
        """Adam for the renderer; created when first needed, like that of the field."""
        parameters = self.renderer.parameters()
        return torch.optim.Adam(parameters, lr=self.options.rate, fused=True)

    def advance(self) -> dict[str, float]:
        """Take one step; return the mean squared errors of the picture and of the base that the
        network corrects; see `loop.look`.

        Raises:
            SteerbenchError: the loss is not finite.
        """
        batch = self.patches.draw(self.options.batch)
        kind = batch.truth.device.type
        with torch.autocast(kind, torch.bfloat16, enabled=multiplies_bf16(kind)):
            drawing = self.renderer(batch.observations)
        loss = functional.mse_loss(drawing.pictures, batch.truth)
        (loss + self._error_loss(batch, drawing) + self._field_loss(batch, drawing)).backward()
        with torch.no_grad():
            base = functional.mse_loss(self.renderer.base(batch.observations), batch.truth)
        shown = {"loss": loss, "picture": drawing.pictures}
        errors = loop.look(self, {"": loss, "base": base}, shown)
        if self.options.clip is not None:
            nn.utils.clip_grad_norm_(self.renderer.parameters(), self.options.clip)
        self._update()
        self.step += 1
        return errors

    def _error_loss(self, batch: Batch, drawing: Drawing) -> Tensor | float:
        """How far the renderer's estimated errors are from its actual errors."""
        if drawing.error is None:
            return 0.0
        errors = (drawing.pictures.detach() - batch.truth).square().mean(dim=-1)
        made = [
            pixels_of(error, o.cells, self.renderer.scale).mean(dim=1)
            for error, o in zip(errors, batch.observations, strict=True)
        ]
        wanted = (torch.cat(made) + LEAST_ERROR).log()
        return self.options.error_weight * functional.mse_loss(drawing.error, wanted)

    def _field_loss(self, batch: Batch, drawing: Drawing) -> Tensor | float:
        """Further loss terms for the field, besides the error of the pictures."""
        return 0.0

    def _update(self) -> None:
        """Update the weights."""
        step_at(self.optimiser, self.rate_now(self.options.rate))
        self._average()

    def rate_now(self, first: float) -> float:
        """The learning rate of the next step, for one that starts at `first`."""
        final, waves = self.options.final_rate / first, self.options.half_waves
        return first * cosine(self.step / self.steps, final, waves)

    @torch.no_grad()
    def _average(self) -> None:
        # At first over fewer steps: the earliest weights are not worth keeping, the first not at
        # all. (torch's AveragedModel would make the host wait for a GPU.)
        early = (1 + self.step) / (10 + self.step) if self.step else 0.0
        mean: list[Tensor] = list(self.mean.parameters())
        new: list[Tensor] = list(self.renderer.parameters())
        torch._foreach_lerp_(mean, new, 1 - min(self.options.average, early))

    def watched(self) -> dict[str, Tensor]:
        """The renderer."""
        return {f"renderer.{name}": x for name, x in self.renderer.named_parameters()}

    def result(self) -> dict[str, Tensor]:
        """The running mean of the renderer."""
        return {f"mean.{name}": x for name, x in self.mean.state_dict().items()}

    def restore_result(self, tensors: Mapping[str, Tensor]) -> None:
        """Restore what `result` returned."""
        self.mean.load_state_dict(checkpoint.part(tensors, "mean."))

    def state(self) -> tuple[dict[str, Tensor], dict[str, float]]:
        """Renderer, optimiser, random numbers, and the sequences that patches are cut from."""
        tensors = {f"renderer.{name}": x for name, x in self.renderer.state_dict().items()}
        tensors |= checkpoint.optimiser_tensors(self.optimiser, "renderer_adam.")
        tensors |= {f"patches.{name}": x for name, x in self.patches.state().items()}
        return tensors | {"generator": self.generator.get_state()}, {}

    def restore(self, tensors: Mapping[str, Tensor], figures: Mapping[str, float]) -> None:
        """See `loop.Training`."""
        self.restore_result(tensors)
        self.renderer.load_state_dict(checkpoint.part(tensors, "renderer."))
        checkpoint.restore_optimiser(self.optimiser, tensors, "renderer_adam.")
        self.patches.restore(checkpoint.part(tensors, "patches."))
        self.generator.set_state(tensors["generator"].cpu())


class JointTraining(RendererTraining):
    """Stage 2 end to end: the field of `patches` is trained as well, in place."""

    patches: PatchSource

    def __init__(
        self,
        trained: TrainedField,
        renderer: Renderer2d,
        patches: PatchSource,
        options: JointOptions,
        steps: int,
        generator: torch.Generator,
    ) -> None:
        super().__init__(renderer, patches, options, steps, generator)
        self.field, self.grid = trained.field, trained.grid
        self.field_optimiser = FieldOptimiser(self.field)
        self._visits = torch.Generator(self.field.device).manual_seed(generator.initial_seed())

    def advance(self) -> dict[str, float]:
        """Step as `RendererTraining` does; the density grid follows the field."""
        if self.options.grid_samples and self.step % EVERY == 0:
            self.grid.update(self.field, self._visits, self.options.grid_samples)
            self.patches.pipeline.occupancy = self.grid.occupancy
        return super().advance()

    def _field_loss(self, batch: Batch, drawing: Drawing) -> Tensor | float:
        return self._opacity_loss(batch.opacity) + self._refinement_loss(batch, drawing)

    def _opacity_loss(self, opacity: Tensor) -> Tensor | float:
        return self.options.opacity_entropy * opacity_entropy(opacity) if len(opacity) else 0.0

    def _refinement_loss(self, batch: Batch, drawing: Drawing) -> Tensor | float:
        """Squared error of rays through the refined cells, estimated from `refined_rays` of them
        and scaled to the batch: it keeps the field accurate at full resolution."""
        pipeline, rendering = self.patches.pipeline, self.patches.rendering
        if not rendering.refined or drawing.error is None:
            return 0.0
        scale, rays, truth = pipeline.model.scale, [], []
        errors = drawing.error.detach().split([len(o.cells) for o in batch.observations])
        for o, view, picture, error in zip(
            batch.observations, batch.views, batch.truth, errors, strict=True
        ):
            worst = o.cells[worst_cells(error, rendering.refined)]
            rays.append(rays_of_cells(worst, view))
            truth.append(pixels_of(picture, worst, scale).flatten(0, 1))
        wanted, every = torch.cat(truth), Rays.joined(rays)
        if not len(wanted):
            return 0.0
        some = torch.randperm(len(wanted), generator=self.generator)[: self.options.refined_rays]
        some = some.to(wanted.device, non_blocking=True)
        pixels, _ = render_batch(
            self.field,
            every.take(some),
            pipeline.occupancy,
            rendering.refined_sampling,
            background=pipeline.background,
            hidden=not compacts(wanted.device),
        )
        error = (pixels.values[:, :3] - wanted[some]).square().sum() / len(some)
        return error * len(wanted) / batch.truth.numel()

    def _update(self) -> None:
        super()._update()
        self.field_optimiser.step(self.rate_now(self.options.field_rate))

    def watched(self) -> dict[str, Tensor]:
        """Table, networks, 2D renderer."""
        return {"table": self.field.table, **self.field.layers, **super().watched()}

    def result(self) -> dict[str, Tensor]:
        """Field, density grid and running mean of the renderer."""
        field = {f"field.{name}": x for name, x in self.field.state_dict().items()}
        return field | {"grid.density": self.grid.density} | super().result()

    def restore_result(self, tensors: Mapping[str, Tensor]) -> None:
        """Restore what `result` returned."""
        super().restore_result(tensors)
        restore_field(self.field, self.grid, tensors)
        self.patches.pipeline.occupancy = self.grid.occupancy

    def state(self) -> tuple[dict[str, Tensor], dict[str, float]]:
        """Also the optimisers of the field and the random numbers of its grid."""
        tensors, figures = super().state()
        visits = {"visits": self._visits.get_state()}
        return tensors | self.field_optimiser.tensors() | visits, figures

    def restore(self, tensors: Mapping[str, Tensor], figures: Mapping[str, float]) -> None:
        """See `loop.Training`."""
        super().restore(tensors, figures)
        self.field_optimiser.restore(tensors)
        self._visits.set_state(tensors["visits"].cpu())

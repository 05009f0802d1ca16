"""Stage 2: the 2D renderer and the field, trained together on patches (Section 3.4)."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from methods.instant_ngp.stage1 import TrainedField
from methods.instant_ngp.training import FieldOptimiser, restore_field
from methods.kernels import multiplies_bf16
from methods.rendering.batch import opacity_entropy
from methods.rendering.occupancy import EVERY
from methods.steernerf.renderer import Renderer2d
from methods.steernerf.training.options import JointOptions
from methods.steernerf.training.patches import Batch, Patches
from methods.training import checkpoint, loop
from methods.training.loop import cosine, step_at


class JointTraining:
    """Stage 2 as a `loop.Training`: trains `renderer` in place, on patches from `patches`, and the
    field `trained`, unless that is None: then it is frozen. `generator` is the source of all random
    numbers, also those of `patches`; `outcome` is the 2D renderer that results.

    A subclass may override `judge`, `update` and `outcome`.
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
        trained: TrainedField | None = None,
    ) -> None:
        self.renderer = self.outcome = renderer
        self.patches, self.options, self.generator = patches, options, generator
        self.step, self.steps, self.seconds = 0, steps, 0.0
        self.trained = trained
        if trained is not None:
            self.field_optimiser = FieldOptimiser(trained.field)
            seed = generator.initial_seed()
            self._visits = torch.Generator(trained.field.device).manual_seed(seed)

    @cached_property
    def optimiser(self) -> torch.optim.Adam:
        """Adam for the renderer; created when first needed, like that of the field."""
        parameters = self.renderer.parameters()
        return torch.optim.Adam(parameters, lr=self.options.rate, fused=True)

    def advance(self) -> dict[str, float]:
        """Take one step; return the mean squared error of the pictures, as `loop.look` does. The
        density grid follows the field.

        Raises:
            SteerbenchError: the loss is not finite.
        """
        if self.trained and self.options.grid_samples and self.step % EVERY == 0:
            grid = self.trained.grid
            grid.update(self.trained.field, self._visits, self.options.grid_samples)
            self.patches.pipeline.occupancy = grid.occupancy
        batch = self.patches.draw(self.options.batch)
        kind = batch.truth.device.type
        with torch.autocast(kind, torch.bfloat16, enabled=multiplies_bf16(kind)):
            drawn = self.renderer(batch.observations)
        pictures, more = self.judge(drawn, batch)
        loss = functional.mse_loss(pictures, batch.truth)
        (loss + more).backward()
        errors = loop.look(self, {"": loss}, {"loss": loss, "picture": pictures})
        self.update()
        self.step += 1
        return errors

    def judge(self, drawn: Any, batch: Batch) -> tuple[Tensor, Tensor | float]:
        """The pictures that the renderer has `drawn`, and the loss besides their squared error."""
        if self.trained and len(batch.opacity):
            return drawn, self.options.opacity_entropy * opacity_entropy(batch.opacity)
        return drawn, 0.0

    def update(self) -> None:
        """Update the weights."""
        step_at(self.optimiser, self.rate_now(self.options.rate))
        if self.trained:
            self.field_optimiser.step(self.rate_now(self.options.field_rate))

    def rate_now(self, first: float) -> float:
        """The learning rate of the next step, for one that starts at `first`."""
        final, waves = self.options.final_rate / first, self.options.half_waves
        return first * cosine(self.step / self.steps, final, waves)

    def watched(self) -> dict[str, Tensor]:
        """Renderer, and the table and networks of a field that learns."""
        watched = _named("renderer.", dict(self.renderer.named_parameters()))
        if self.trained:
            watched |= {"table": self.trained.field.table, **self.trained.field.layers}
        return watched

    def result(self) -> dict[str, Tensor]:
        """Renderer, and field and density grid if they learn."""
        result = _named("outcome.", self.outcome.state_dict())
        if self.trained:
            result |= _named("field.", self.trained.field.state_dict())
            result["grid.density"] = self.trained.grid.density
        return result

    def restore_result(self, tensors: Mapping[str, Tensor]) -> None:
        """Restore what `result` returned."""
        self.outcome.load_state_dict(checkpoint.part(tensors, "outcome."))
        if self.trained:
            restore_field(self.trained.field, self.trained.grid, tensors)
            self.patches.pipeline.occupancy = self.trained.grid.occupancy

    def state(self) -> tuple[dict[str, Tensor], dict[str, float]]:
        """Optimisers, random numbers, and the examples that patches are cut from."""
        tensors = checkpoint.optimiser_tensors(self.optimiser, "renderer_adam.")
        tensors |= _named("patches.", self.patches.state())
        tensors["generator"] = self.generator.get_state()
        if self.trained:
            tensors |= {"visits": self._visits.get_state(), **self.field_optimiser.tensors()}
        return tensors, {}

    def restore(self, tensors: Mapping[str, Tensor], figures: Mapping[str, float]) -> None:
        """Restore what `result` and `state` returned."""
        self.restore_result(tensors)
        checkpoint.restore_optimiser(self.optimiser, tensors, "renderer_adam.")
        self.patches.restore(checkpoint.part(tensors, "patches."))
        self.generator.set_state(tensors["generator"].cpu())
        if self.trained:
            self.field_optimiser.restore(tensors)
            self._visits.set_state(tensors["visits"].cpu())


def _named(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {f"{prefix}{name}": x for name, x in tensors.items()}

"""Stage 2: the 2D renderer, and with it the field, trained on patches of pictures (Section 3.5)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.optim.swa_utils import AveragedModel

from methods import checkpoint, loop
from methods.fields import HashField
from methods.optimise import FieldOptimiser, step_at
from methods.patches import Patches, Through
from methods.renderer2d import Renderer2d
from methods.sequences import MotionOptions

Tensors = tuple[Tensor, ...] | list[Tensor]


@dataclass(frozen=True)
class JointOptions:
    """How stage 2 is trained.

    Attributes:
        field: "joint", or "frozen" as stage 1 left it (the ablation of the paper's Table 5).
        through: which frames the field learns from: "all", also the preceding ones, or only the
            "present" one.
        rate: learning rate of the 2D renderer at the beginning.
        field_rate: of the field.
        final_rate: share of both left at the end of the cosine schedule.
        patch: side of a patch, low-resolution pixels.
        batch: patches of a step.
        precision: of the 2D renderer's convolutions while it is trained.
        opacity_entropy: weight of -o ln o of the rays.
        clip: largest norm of the 2D renderer's gradient.
        average: decay of the running mean of the 2D renderer's weights that is used in the end.
        distilled_views: most pictures of the stage 1 field at random views, to learn from as well.
        distilled_share: of the patches that are taken from those.
        motion: what precedes a training view.
    """

    field: Literal["joint", "frozen"] = "joint"
    through: Through = "present"
    rate: float = 1e-3
    field_rate: float = 3e-3
    final_rate: float = 0.01
    patch: int = 32
    batch: int = 2
    precision: Literal["bf16", "fp32"] = "bf16"
    opacity_entropy: float = 1e-3
    clip: float = 1.0
    average: float = 0.999
    distilled_views: int = 100
    distilled_share: float = 0.5
    motion: MotionOptions = MotionOptions()

    def __post_init__(self) -> None:
        if not (self.rate > 0 and self.field_rate > 0 and 0 < self.final_rate <= 1):
            raise ValueError(f"expected rates > 0, final_rate in (0, 1]: {self}")
        if not (self.patch >= 1 and self.batch >= 1 and self.clip > 0 and 0 <= self.average < 1):
            raise ValueError(f"expected patch, batch >= 1, clip > 0, average in [0, 1): {self}")
        if not (self.distilled_views >= 0 and 0 <= self.distilled_share <= 1):
            raise ValueError(f"expected distilled_views >= 0 and distilled_share in [0, 1]: {self}")

    def distilled(self, steps: int) -> int:
        """Distilled views of a training of so many steps: no more than it has a use for."""
        sequences = self.motion.pool + steps * self.batch / self.motion.uses
        return min(self.distilled_views, math.ceil(self.distilled_share * sequences))


class RendererTraining:
    """Stage 2 of the 2D renderer alone, as a `loop.Training`: the field stays as it is.

    Args:
        renderer: trained in place.
        patches: what it is shown.
        steps: optimiser steps.
        generator: of all random numbers, also those of `patches`.

    Attributes:
        mean: the running mean of the renderer's weights, which is what is used in the end.
    """

    advice = "Try smaller learning rates (method.joint.rate, method.joint.field_rate)."

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
        self.optimiser = torch.optim.Adam(renderer.parameters(), lr=options.rate, fused=True)
        self._averaged = AveragedModel(renderer, multi_avg_fn=self._average)
        self.mean: Renderer2d = self._averaged.module  # type: ignore[assignment]

    def advance(self) -> dict[str, float]:
        """One step; mean squared error of the picture and of the base that it corrects.

        Raises:
            SteerbenchError: the loss is not finite.
        """
        observations, truth, opacity = self.patches.draw(self.options.batch)
        half = self.options.precision == "bf16"
        with torch.autocast(truth.device.type, torch.bfloat16, enabled=half):
            drawn = self.renderer(observations)
        loss = functional.mse_loss(drawn, truth)
        (loss + self._regularisation(opacity)).backward()
        value = loss.item()
        if not math.isfinite(value):
            loop.check_finite(self, {"loss": loss, "picture": drawn})
        nn.utils.clip_grad_norm_(self.renderer.parameters(), self.options.clip)
        low = self.options.final_rate
        self._update(low + (1 - low) * 0.5 * (1 + math.cos(math.pi * self.step / self.steps)))
        self.step += 1
        with torch.no_grad():
            base = functional.mse_loss(self.renderer.base(observations), truth).item()
        return {"": value, "base": base}

    def _regularisation(self, opacity: Tensor) -> Tensor | float:
        return 0.0

    def _update(self, share: float) -> None:
        """Change the weights, at `share` of the learning rates of the beginning."""
        step_at(self.optimiser, share * self.options.rate)
        self._averaged.update_parameters(self.renderer)

    @torch.no_grad()
    def _average(self, mean: Tensors, new: Tensors, count: Tensor | int) -> None:
        # In the beginning, over fewer steps: the first weights are not worth remembering.
        keep = min(self.options.average, (1 + int(count)) / (10 + int(count)))
        torch._foreach_lerp_(mean, new, 1 - keep)

    def watched(self) -> dict[str, Tensor]:
        """The renderer."""
        return {f"renderer.{name}": x for name, x in self.renderer.named_parameters()}

    def result(self) -> dict[str, Tensor]:
        """The running mean of the renderer."""
        return {f"mean.{name}": x for name, x in self.mean.state_dict().items()}

    def restore_result(self, tensors: Mapping[str, Tensor]) -> None:
        """Put back what `result` gave."""
        self.mean.load_state_dict(checkpoint.part(tensors, "mean."))

    def state(self) -> tuple[dict[str, Tensor], dict[str, float]]:
        """Renderer, optimiser, random numbers. The sequences are not in it: going on, they are
        rendered anew."""
        tensors = {f"renderer.{name}": x for name, x in self.renderer.state_dict().items()}
        tensors |= checkpoint.optimiser_tensors(self.optimiser, "renderer_adam.")
        return tensors | {
            "generator": self.generator.get_state(),
            "averaged": self._averaged.n_averaged,
        }, {}

    def restore(self, tensors: Mapping[str, Tensor], figures: Mapping[str, float]) -> None:
        """See `loop.Training`."""
        self.restore_result(tensors)
        self.renderer.load_state_dict(checkpoint.part(tensors, "renderer."))
        checkpoint.restore_optimiser(self.optimiser, tensors, "renderer_adam.")
        self.generator.set_state(tensors["generator"].cpu())
        self._averaged.n_averaged.copy_(tensors["averaged"])


class JointTraining(RendererTraining):
    """Stage 2 end to end: the field learns through the 2D renderer.

    Args:
        field: that `patches` are rendered from; trained in place.
    """

    def __init__(
        self,
        field: HashField,
        renderer: Renderer2d,
        patches: Patches,
        options: JointOptions,
        steps: int,
        generator: torch.Generator,
    ) -> None:
        super().__init__(renderer, patches, options, steps, generator)
        self.field = field
        self.field_optimiser = FieldOptimiser(field, fused=True)

    def _regularisation(self, opacity: Tensor) -> Tensor | float:
        if not len(opacity):
            return 0.0
        opacity = opacity.clamp(1e-5, 1 - 1e-5)
        return -self.options.opacity_entropy * (opacity * opacity.log()).mean()

    def _update(self, share: float) -> None:
        super()._update(share)
        self.field_optimiser.step(share * self.options.field_rate)

    def watched(self) -> dict[str, Tensor]:
        """Table, networks, 2D renderer."""
        return {"table": self.field.table, **self.field.layers, **super().watched()}

    def result(self) -> dict[str, Tensor]:
        """Field and running mean of the renderer."""
        field = {f"field.{name}": x for name, x in self.field.state_dict().items()}
        return field | super().result()

    def restore_result(self, tensors: Mapping[str, Tensor]) -> None:
        """Put back what `result` gave."""
        super().restore_result(tensors)
        self.field.load_state_dict(checkpoint.part(tensors, "field."))
        self.field.repack()

    def state(self) -> tuple[dict[str, Tensor], dict[str, float]]:
        """The optimisers of the field, too."""
        tensors, figures = super().state()
        return tensors | self.field_optimiser.tensors(), figures

    def restore(self, tensors: Mapping[str, Tensor], figures: Mapping[str, float]) -> None:
        """See `loop.Training`."""
        super().restore(tensors, figures)
        self.field_optimiser.restore(tensors)

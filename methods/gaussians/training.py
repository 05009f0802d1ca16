"""Training of Gaussians on pictures (Kerbl et al. 2023, Section 5; Kheradmand et al. 2024)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor
from torch.nn import functional

from bench.cameras import place_camera, scale_camera
from bench.types import Camera, NullProbe, Scene, composite
from methods.gaussians.kernels.ssim import ssim
from methods.gaussians.mcmc import disturb, relocate
from methods.gaussians.model import Gaussians
from methods.kernels.composite import STOP
from methods.kernels.types import expect
from methods.training import checkpoint, loop


@dataclass(frozen=True)
class Fitting:
    """How to train Gaussians; rates are those of Adam.

    Attributes:
        means, scales, rotations, opacities, colours: learning rates; harmonics beyond the first
            have a twentieth of `colours`. Means are in scene units.
        final_means: share of the rate of the means that is left at the end; it falls exponentially.
        similarity: weight of 1 - SSIM; the mean absolute error has the rest.
        opacity_cost, scale_cost: weights of the mean opacity and of the mean scale, so that
            Gaussians that are not needed fade.
        noise: noise on the means, as a multiple of their rate.
        every: steps between two relocations of faded Gaussians.
        relocate_from, relocate_to: shares of the training between which they are relocated.
        half: share of the training, at its beginning, on pictures of half the resolution.
        opacity: initial opacity.
        size: initial scales, as a multiple of the distance between neighbours.
    """

    means: float = 3e-4
    final_means: float = 0.01
    scales: float = 1e-2
    rotations: float = 1e-3
    opacities: float = 5e-2
    colours: float = 2e-2
    similarity: float = 0.2
    opacity_cost: float = 2e-3
    scale_cost: float = 0.01
    noise: float = 5e5
    every: int = 100
    relocate_from: float = 0.02
    relocate_to: float = 0.8
    half: float = 0.5
    opacity: float = 0.5
    size: float = 0.5

    def __post_init__(self) -> None:
        expect(0 < self.opacity < 1, "opacity", "more than 0 and less than 1", self.opacity)
        expect(self.size > 0, "size", "more than 0", self.size)
        expect(self.every > 0, "every", "1 or more", self.every)


class GaussianTraining:
    """Trains Gaussians, as a `methods.training.loop.Training`: on one picture per step."""

    advice = "Try a smaller rate (method.fitting.means)."
    asked: loop.Asked | None = None

    def __init__(
        self,
        gaussians: Gaussians,
        scene: Scene,
        steps: int,
        options: Fitting,
        backend: str,
        seed: int,
    ) -> None:
        device = gaussians.means.device
        self.gaussians, self.options, self.backend = gaussians, options, backend
        self.step, self.steps, self.seconds = 0, steps, 0.0
        self.split, self.background = scene.splits["train"], scene.background.to(device)
        self.generator = torch.Generator(device).manual_seed(seed)
        self.views: list[int] = []  # still to come in this pass over the pictures

    @cached_property
    def optimiser(self) -> torch.optim.Adam:
        """Created when first needed, like that of a field."""
        options = self.options
        rates = {
            "means": options.means,
            "log_scales": options.scales,
            "rotations": options.rotations,
            "logits": options.opacities,
            "base": options.colours,
            "view": options.colours / 20,
        }
        groups = [
            {"params": [getattr(self.gaussians, name)], "lr": rate} for name, rate in rates.items()
        ]
        return torch.optim.Adam(groups, eps=1e-15, fused=True)

    def advance(self) -> dict[str, float]:
        """Take one step; return its mean squared error, see `loop.look`.

        Raises:
            SteerbenchError: the error is not finite.
        """
        options, gaussians = self.options, self.gaussians
        share = self.step / self.steps
        camera, target = self._picture(half=share < options.half)
        pixels = gaussians.render(camera, STOP, NullProbe(), self.backend)
        picture = pixels.over(self.background).values.view_as(target)
        loss = (1 - options.similarity) * functional.l1_loss(picture, target)
        if options.similarity:
            loss = loss + options.similarity * (1 - ssim(picture, target, backend=self.backend))
        costs = (
            options.opacity_cost * gaussians.opacities.mean()
            + options.scale_cost * gaussians.log_scales.exp().mean()
        )
        (loss + costs).backward()
        errors = loop.look(self, {"": functional.mse_loss(picture, target)}, {"picture": picture})
        rate = options.means * options.final_means**share
        self.optimiser.param_groups[0]["lr"] = rate
        self.optimiser.step()
        self.optimiser.zero_grad(set_to_none=True)
        self.step += 1
        if options.relocate_from <= share < options.relocate_to and self.step % options.every == 0:
            relocate(gaussians, self.optimiser, self.generator)
        if options.noise:
            disturb(gaussians, options.noise * rate, self.generator)
        return errors

    def _picture(self, half: bool) -> tuple[Camera, Tensor]:
        """The next training view and its picture [H, W, 3]; a pass uses every view once."""
        if not self.views:
            order = torch.randperm(
                len(self.split), generator=self.generator, device=self.generator.device
            )
            self.views = order.tolist()
        view = self.views.pop()
        camera, device = self.split.cameras[view], self.background.device
        picture = composite(self.split.images[view].to(device, non_blocking=True), self.background)
        if half and min(camera.width, camera.height) > 1:
            camera = scale_camera(camera, camera.width // 2, camera.height // 2)
            shrunk = functional.interpolate(
                picture.movedim(-1, 0)[None], size=(camera.height, camera.width), mode="area"
            )
            picture = shrunk[0].movedim(0, -1).contiguous()
        return place_camera(camera, device), picture

    def watched(self) -> dict[str, Tensor]:
        return dict(self.gaussians.named_parameters())

    def result(self) -> dict[str, Tensor]:
        return {name: value.detach() for name, value in self.gaussians.named_parameters()}

    def restore_result(self, tensors: Mapping[str, Tensor]) -> None:
        self.gaussians.load_state_dict({name: tensors[name] for name in self.result()})

    def state(self) -> tuple[dict[str, Tensor], dict[str, float]]:
        """The optimiser, random numbers, and the views still to come."""
        more = {
            "generator": self.generator.get_state(),
            "views": torch.tensor(self.views, dtype=torch.int64),
        }
        return checkpoint.optimiser_tensors(self.optimiser, "adam.") | more, {}

    def restore(self, tensors: Mapping[str, Tensor], figures: Mapping[str, float]) -> None:
        self.restore_result(tensors)
        checkpoint.restore_optimiser(self.optimiser, tensors, "adam.")
        self.generator.set_state(tensors["generator"].cpu())
        self.views = tensors["views"].tolist()

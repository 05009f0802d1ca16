"""Training of corners and decoder on random pixels of the training pictures."""

from dataclasses import dataclass

import torch
from torch import Tensor

from bench.types import Budget, Rays, Scene
from methods.diver.kernels.segments import as_intervals
from methods.diver.model import CornerModel
from methods.instant_ngp.training import PixelOptions, PixelTraining
from methods.kernels.adam import AdamState, sparse_adam_
from methods.kernels.composite import STOP, composite, visibility
from methods.kernels.settings import Count, Fraction, NotNegative, Positive, Share
from methods.kernels.types import Composited
from methods.kernels.voxel_walk import Crossings, walk
from methods.rendering.field import pad
from methods.students.networks import encode_directions
from methods.students.voxels import largest_weights
from methods.training.checkpoint import Optimisers, Tensors
from methods.training.loop import step_at


@dataclass(frozen=True)
class DiverLessons(PixelOptions):
    """How to train the model, as `sweeps/configs/method/diver.yaml` explains; `rate` is that of the
    decoder."""

    corner_rate: Positive
    sparsity: NotNegative
    prune_at: Share
    prune_below: Fraction
    prune_rays: Count


class DiverTraining(PixelTraining):
    """Trains corners and decoder on some thousand rays a step."""

    options: DiverLessons

    def __init__(
        self, model: CornerModel, scene: Scene, budget: Budget, options: DiverLessons, seed: int
    ) -> None:
        device = model.table.device
        super().__init__(scene, device, budget.renderer_steps, budget.samples, options, seed)
        self.model = model
        self.networks = torch.optim.Adam(model.decoder.parameters(), betas=(0.9, 0.99), eps=1e-15)
        self.moments = AdamState.like(model.table.detach())
        self.grad = torch.zeros_like(model.table)

    def advance(self) -> dict[str, float]:
        if self.step == max(int(self.options.prune_at * self.steps), 1):
            self._prune()
        return super().advance()

    def _render(self, rays: Rays, jitter: Tensor, background: Tensor) -> Composited:
        # A segment is integrated exactly: there is nothing to jitter.
        model, backend = self.model, self.model.backend
        crossings = walk(rays, model.voxels, backend=backend)
        sigma = self._densities(rays, crossings)
        # What lies behind an opaque surface has neither weight nor gradient.
        seen = visibility(sigma, as_intervals(crossings), stop=STOP, backend=backend)
        crossings = crossings.front(seen.counts)
        count = len(crossings)
        weight = model.weights(rays, crossings)
        features = model.features(pad(crossings.voxel), pad(weight), self.grad)
        raw, geometry = model.decoder.density(features)
        self._push_to_sparsity(raw, count)
        encoded = encode_directions(rays.directions)
        colours = model.decoder.colours(geometry, encoded, pad(crossings.ray))
        sigma, intervals = raw[:count].relu(), as_intervals(crossings)
        pixels = composite(sigma, colours[:count], intervals, stop=STOP, backend=backend)
        return pixels.over(background), count

    def _push_to_sparsity(self, raw: Tensor, count: int) -> None:
        """Add the gradient of the sparsity term, the mean of log(1 + 2 sigma^2), to that of the
        first `count` densities `raw`, before their ReLU: negative ones are drawn back to 0."""
        if self.options.sparsity and raw.requires_grad:
            slope = 4 * raw.detach() / (1 + 2 * raw.detach().square())
            slope[count:] = 0
            push = self.options.sparsity / max(count, 1) * slope
            raw.register_hook(lambda grad: grad + push)

    @torch.no_grad()
    def _densities(self, rays: Rays, crossings: Crossings) -> Tensor:
        """Integrated densities [S]."""
        model, weight = self.model, self.model.weights(rays, crossings)
        features = model.features(pad(crossings.voxel), pad(weight))
        return model.decoder.density(features)[0][: len(crossings)].relu()

    @torch.no_grad()
    def _prune(self) -> None:
        """Prune the voxels that hardly show on any of many rays (their Section 4.1)."""
        model, options = self.model, self.options

        def weigh(rays: Rays, crossings: Crossings) -> Tensor:
            sigma = self._densities(rays, crossings)
            every = as_intervals(crossings)
            return visibility(sigma, every, stop=STOP, backend=model.backend).weights

        rays = self.batches, options.prune_rays, self.generator
        kept = largest_weights(model.voxels, weigh, *rays, model.backend) >= options.prune_below
        if not kept.any():  # the decoder has learned nothing yet
            return
        rows = model.keep(kept).long()
        moments = self.moments
        self.moments = AdamState(moments.first[rows], moments.second[rows], moments.steps[rows])
        self.grad = torch.zeros_like(model.table)

    def optimisers(self) -> Optimisers:
        return {"adam": self.networks, "moments": self.moments}

    def _update(self) -> None:
        rate = self.learning_rate()
        step_at(self.networks, rate)
        corner_rate = rate * self.options.corner_rate / self.options.rate
        table = self.model.table.detach()
        sparse_adam_(table, self.grad, self.moments, corner_rate, backend=self.model.backend)

    def watched(self) -> Tensors:
        moments = self.moments.first + self.moments.second
        decoder = dict(self.model.decoder.named_parameters())
        return {"corner features": self.model.table, "their moments": moments, **decoder}

    def result(self) -> Tensors:
        return self.model.tensors()

    def restore_result(self, tensors: Tensors) -> None:
        self.model.restore(tensors)
        self.grad = torch.zeros_like(self.model.table)

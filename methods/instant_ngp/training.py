"""Stage 1: a hash-grid field learns from random pixels of the training pictures."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated

import torch
from torch import Tensor

from bench.types import Budget, Rays, Scene, SteerbenchError, TwoTensors
from methods.instant_ngp.field import HashField
from methods.instant_ngp.pixels import REFRESHED, ErrorMap, PixelBatches
from methods.kernels.adam import AdamState, hash_adam_
from methods.kernels.encode import SampleGradients
from methods.kernels.settings import (
    Checked,
    Fraction,
    Length,
    NotNegative,
    Only,
    Positive,
    SomeShare,
    Stop,
)
from methods.kernels.types import Composited
from methods.rendering.batch import opacity_entropy, render_batch
from methods.rendering.occupancy import EVERY, MIN_VIEWS, STEP, DensityGrid, learnable_cells
from methods.rendering.sampling import Sampling, suitable_step
from methods.training import checkpoint, loop
from methods.training.checkpoint import Optimisers, Tensors

MIN_RAYS = 64  # minimum number of rays in a step
Enough = Annotated[int, Only(f"{MIN_RAYS} or more", lambda x: x >= MIN_RAYS)]

GRID_YOUTH_STEPS = 256
"""Up to this step the density grid is visited four times as much: most of it is still unknown."""


@dataclass(frozen=True)
class PixelOptions(Checked):
    """How to train on random pixels."""

    rate: Positive  # initial learning rate
    final_rate: SomeShare  # share of it left at the end of the cosine schedule
    opacity_entropy: NotNegative  # weight of -o ln o, which drives an opacity to 0 or 1
    # Composite RGBA pictures on a random colour per ray instead of the scene's background, so that
    # no density can pass for background.
    random_background: bool
    max_rays: Enough  # maximum number of rays in a step
    by_error: Fraction  # of the rays, that an `ErrorMap` draws; the rest see all alike


@dataclass(frozen=True)
class TrainingOptions(PixelOptions):
    """How to train a field in stage 1; `rate` is that of table and networks."""

    march_step: Length | None  # of the rays, in diagonals of the cube / 1024; None: `suitable_step`
    share: SomeShare  # samples with a gradient in a step, as a share of the budget's
    # Cells visited in an update of the density grid.
    grid_samples: Annotated[int, Only("2 or more", lambda x: x >= 2)]
    rays: Enough | None  # in every step; None: as many as give `share`
    stop: Stop  # transmittance at which a ray ends
    thin: NotNegative  # see `Sampling`

    def sampling(self, budget: Budget) -> Sampling:
        """How rays are marched in a training within `budget`, and later to render its result."""
        if self.march_step is None:
            return Sampling(step=suitable_step(budget.steps))
        return Sampling(step=self.march_step * STEP)


def new_grid(scene: Scene, device: torch.device) -> DensityGrid:
    """Make the density grid for a training of `scene`, as it is before the first step."""
    contracted = scene.space == "all"
    cells = learnable_cells(scene.cells.to(device), scene.splits["train"].cameras, contracted)
    if not cells.any():
        raise SteerbenchError(
            f"scene {scene.name}: no part of the unit cube is seen by {MIN_VIEWS} training "
            "cameras: expected pictures that overlap there; look at the poses and the scale"
        )
    return DensityGrid(cells, contracted)


class PixelTraining(loop.Training, ABC):
    """A training whose steps render random pixels of the training pictures. Subclasses say what is
    trained, how its rays are rendered and how its parameters are updated. A step aims at `samples`
    samples with a gradient; the number of rays follows from it."""

    advice = "Try a smaller learning rate (method.training.rate)."

    def __init__(
        self,
        scene: Scene,
        device: torch.device,
        steps: int,
        samples: int,
        options: PixelOptions,
        seed: int,
    ) -> None:
        self.options, self.samples, self.steps = options, samples, steps
        self.batches = PixelBatches(scene.splits["train"], device)
        self.errors = ErrorMap(len(self.batches), device) if options.by_error else None
        self.background = scene.background.to(device)
        self.opaque = scene.space == "all"  # what is not transparent must hide what is behind it
        self.rays = min(1024, options.max_rays)
        self.generator = torch.Generator(device).manual_seed(seed)

    @abstractmethod
    def _render(self, rays: Rays, jitter: Tensor, background: Tensor) -> Composited:
        """Render R `rays` on `background` [3] or [R, 3], differentiably; also return the number of
        samples that were composited. `jitter` [R] in [0, 1) is the phase of the samples."""

    @abstractmethod
    def _update(self) -> None:
        """Take a step of the optimisers and clear the gradients."""

    def learning_rate(self) -> float:
        """The learning rate of the next step."""
        return self.options.rate * loop.cosine(self.step / self.steps, self.options.final_rate)

    def advance(self) -> dict[str, float]:
        numbers, alike = self._numbers()
        rays, colours = self.batches.at(numbers)
        target, background = self._target(colours)
        jitter = torch.rand(len(target), generator=self.generator, device=target.device)
        pixels, samples = self._render(rays, jitter, background)
        each = (pixels.values - target).square().mean(dim=1)
        loss = each.mean()
        (loss + self.options.opacity_entropy * opacity_entropy(pixels.alpha)).backward()
        if self.errors is not None:
            self.errors.learn(numbers, each.detach())

        def shown() -> Tensors:
            return {"": each[:alike].mean() + 0 * loss}  # not finite if any error is not

        errors = loop.look(self, shown, {"loss": loss, "rendered pixels": pixels.values})
        self._update()
        self._fit_batch(samples)
        self.step += 1
        return errors

    def _numbers(self) -> tuple[Tensor, int]:
        """Draw the pixels of a step; also return how many of them, the first, were drawn from all
        pixels alike."""
        if self.errors is None:
            return self.batches.choose(self.rays, self.generator), self.rays
        if self.step % REFRESHED == 0:
            self.errors.refresh()
        wrong = int(self.options.by_error * self.rays)
        alike = self.batches.choose(self.rays - wrong, self.generator)
        return torch.cat((alike, self.errors.draw(wrong, self.generator))), len(alike)

    def _target(self, colours: Tensor) -> TwoTensors:
        """Composite colours on a background; also return that background, [3] or [R, 3]."""
        background, generator = self.background, self.generator
        solid = colours.shape[-1] == 3
        if self.options.random_background and (self.opaque or not solid):
            count, device = len(colours), colours.device
            background = torch.rand(count, 3, generator=generator, device=device)
        if solid:
            return colours, background
        rgb, alpha = colours[:, :3], colours[:, 3:]
        return rgb * alpha + background * (1 - alpha), background

    def _fit_batch(self, samples: int) -> None:
        """Choose the number of rays so that the next step has about `self.samples` samples."""
        change = min(max(self.samples / max(samples, 1), 0.5), 1.25)
        self.rays = min(max(int(self.rays * change), MIN_RAYS), self.options.max_rays)

    def state(self) -> Tensors:
        tensors = super().state() | {"rays": torch.tensor(self.rays)}
        if self.errors is not None:
            tensors |= {"errors": self.errors.errors, "error_ends": self.errors.ends}
        return tensors

    def restore(self, tensors: Tensors) -> None:
        super().restore(tensors)
        self.rays = int(tensors["rays"])
        if self.errors is not None:
            self.errors.errors.copy_(tensors["errors"])
            self.errors.ends.copy_(tensors["error_ends"])


class FieldTraining(PixelTraining):
    """Stage 1: trains a hash-grid field and its density grid."""

    options: TrainingOptions

    def __init__(
        self, field: HashField, scene: Scene, budget: Budget, options: TrainingOptions, seed: int
    ) -> None:
        samples = math.ceil(options.share * budget.samples)
        super().__init__(scene, field.device, budget.steps, samples, options, seed)
        self.field, self.grid = field, new_grid(scene, field.device)
        self.sampling = replace(options.sampling(budget), stop=options.stop, thin=options.thin)
        self.rays = options.rays or self.rays
        self.optimiser = FieldOptimiser(field)

    def advance(self) -> dict[str, float]:
        if self.step % EVERY == 0:
            times = 4 if self.step < GRID_YOUTH_STEPS else 1
            self.grid.update(self.field, self.generator, times * self.options.grid_samples)
        return super().advance()

    def _render(self, rays: Rays, jitter: Tensor, background: Tensor) -> Composited:
        field, cells, how = self.field, self.grid.occupancy, self.sampling
        return render_batch(field, rays, cells, how, jitter=jitter, background=background)

    def optimisers(self) -> Optimisers:
        return self.optimiser.parts

    def _update(self) -> None:
        self.optimiser.step(self.learning_rate())

    def _fit_batch(self, samples: int) -> None:
        if self.options.rays is None:
            super()._fit_batch(samples)

    def watched(self) -> Tensors:
        moments = self.optimiser.table
        both = moments.first + moments.second
        return {"table": self.field.table, "table moments": both, **self.field.layers}

    def result(self) -> Tensors:
        return self.field.state_dict(prefix="field.") | {"grid.density": self.grid.density}

    def restore_result(self, tensors: Tensors) -> None:
        restore_field(self.field, self.grid, tensors)


def restore_field(field: HashField, grid: DensityGrid, tensors: Tensors) -> None:
    """Restore what `FieldTraining.result` returned."""
    field.load_state_dict(checkpoint.part(tensors, "field."))
    field.repack()
    grid.restore(tensors["grid.density"])


class FieldOptimiser:
    """Adam for the networks of `field`, and for its table one that skips untouched entries. Once
    this exists, the field collects the gradients of its samples in `gradients`, until `step`."""

    def __init__(self, field: HashField) -> None:
        self._field = field
        self.table = AdamState.like(field.table.detach())
        field.gradients = SampleGradients()

    @cached_property
    def _networks(self) -> torch.optim.Adam:
        # Created when needed: a process's first one imports torch's compiler, which takes seconds.
        parameters = list(self._field.layers.values())
        return torch.optim.Adam(parameters, betas=(0.9, 0.99), eps=1e-15, fused=True)

    def step(self, rate: float) -> None:
        """Update table and networks at learning rate `rate`."""
        loop.step_at(self._networks, rate)
        field = self._field
        assert field.gradients is not None
        given = field.table.detach(), field.gradients, field.grid, self.table, rate
        hash_adam_(*given, packed=field.packed, backend=field.backend)

    @property
    def parts(self) -> Optimisers:
        """Both, for a checkpoint."""
        return {"table": self.table, "networks": self._networks}

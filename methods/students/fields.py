"""Students that are fields: they learn the densities and colours of a trained field, their teacher,
then the photos."""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn
from torch.nn import functional

from bench.types import Budget, Log, Probe, Rays, Scene, TwoTensors
from methods.instant_ngp.stage1 import TrainedField
from methods.instant_ngp.training import PixelOptions, PixelTraining
from methods.kernels.settings import Share, SomeShare
from methods.kernels.types import Composited, Occupancy
from methods.rendering.batch import render_batch
from methods.rendering.field import ROUND_SAMPLES, Field
from methods.rendering.frame import Renderer, everywhere
from methods.rendering.occupancy import STEP
from methods.rendering.sampling import Sampling
from methods.students.method import Student
from methods.training import checkpoint, loop
from methods.training.checkpoint import Optimisers, Tensors

REACH = 5 * STEP
"""Length over which densities become the opacities that are compared: about the 0.0211 of KiloNeRF,
in the units of its scenes."""


@dataclass(frozen=True)
class FieldLessons(PixelOptions):
    """How to train a student that is a field: first on points, then on rays as Instant-NGP is. One
    large network takes many small steps, at a lower rate than a hash grid."""

    # Share of the steps, at the beginning, that compare densities and colours at random points of
    # occupied cells with the teacher's.
    points: Share
    share: SomeShare  # samples with a gradient in a step, as a share of the budget's


class StudentField(nn.Module, Field):
    """A trainable field whose features are colours, rendered by kernels of `backend`."""

    channels = 3
    round_samples = ROUND_SAMPLES

    def __init__(self, backend: str) -> None:
        super().__init__()
        self.backend = backend

    @property
    def device(self) -> torch.device:
        return next(self.parameters()).device

    @abstractmethod
    def sizes(self) -> dict[str, int]:
        """Bytes by component."""


class FieldStudent(Student):
    """Base of the methods that train another field and render it as Instant-NGP is rendered."""

    training: FieldLessons

    @abstractmethod
    def new_field(self) -> StudentField:
        """Make the untrained field on the device of its teacher, with weights drawn from the seed;
        the occupied cells are known already."""

    def occupied(self, teacher: TrainedField) -> Occupancy:
        """The cells in which the field may hold matter; it is empty elsewhere."""
        return teacher.occupancy

    def sampling(self, budget: Budget) -> Sampling:
        """How its rays are sampled in training: as those of its teacher."""
        return self.teacher.training.sampling(budget)

    def begin(self, teacher: TrainedField, scene: Scene, budget: Budget) -> StudentTraining:
        self.occupancy = self.occupied(teacher)
        return StudentTraining(self, teacher, scene, budget)

    def restore(self, tensors: Tensors) -> None:
        self.occupancy = Occupancy(tensors["cells"].to(self.teacher.device), self.contracted)
        self.field = self.new_field()
        self.field.load_state_dict(checkpoint.part(tensors, "field."))

    def fit(self, scene: Scene, budget: Budget, log: Log) -> None:
        """Train both fields, or load them; frames are sampled as the training was."""
        super().fit(scene, budget, log)
        self.how = replace(self.sampling(budget), stop=self.stop)

    def renderer(self, probe: Probe) -> Renderer:
        return self.occupancy, everywhere(self.field, self.occupancy, probe, self.how)

    def sizes(self) -> dict[str, int]:
        return self.field.sizes() | {"occupancy": self.occupancy.cells.numel() // 8}


class StudentTraining(PixelTraining):
    """Trains a new field on points of the teacher, then on rays of the photos, within occupied
    cells. On rays, samples that the teacher's density hides are left out: it costs less than the
    density of a large network. The training follows the settings of `student`."""

    def __init__(
        self, student: FieldStudent, teacher: TrainedField, scene: Scene, budget: Budget
    ) -> None:
        options, seed = student.training, student.teacher.seed
        samples, device = math.ceil(options.share * budget.samples), teacher.field.device
        super().__init__(scene, device, budget.renderer_steps, samples, options, seed)
        self.field, self.teacher = student.new_field(), teacher.field
        self.occupancy, self.sampling = student.occupancy, student.sampling(budget)
        self.cells = self.occupancy.cells.nonzero()
        self.points_until = options.points * self.steps if len(self.cells) else 0
        parameters = self.field.parameters()
        self.optimiser = torch.optim.Adam(parameters, betas=(0.9, 0.99), eps=1e-15, fused=True)

    def advance(self) -> dict[str, float]:
        """Take one step; return its mean squared error, of opacities and colours or of pixels."""
        if self.step >= self.points_until:
            return super().advance()
        positions = self._places()
        shape, device = positions.shape, positions.device
        directions = torch.randn(shape, generator=self.generator, device=device)
        loss = self._difference(positions, functional.normalize(directions, dim=1))
        loss.backward()
        errors = loop.look(self, lambda: {"": loss}, {"loss": loss})
        self._update()
        self.step += 1
        return errors

    def _places(self) -> Tensor:
        """Random points [S, 3] in occupied cells."""
        count, device, generator = self.samples, self.cells.device, self.generator
        chosen = torch.randint(len(self.cells), (count,), generator=generator, device=device)
        jitter = torch.rand(count, 3, generator=generator, device=device)
        return (self.cells[chosen] + jitter) / self.occupancy.resolution

    def _difference(self, positions: Tensor, directions: Tensor) -> Tensor:
        """Mean squared difference in opacity over `REACH`, plus those in red, green and blue,
        weighted by the teacher's opacity."""
        with torch.no_grad():
            wanted, shown = _seen(self.teacher, positions, directions)
        opacity, colour = self._learned(positions, directions)
        apart = (colour - shown).square().sum(dim=1)
        return functional.mse_loss(opacity, wanted) + (wanted * apart).mean()

    def _learned(self, positions: Tensor, directions: Tensor) -> TwoTensors:
        """The opacity [S] over `REACH` and colour [S, 3] that are compared with the teacher's."""
        return _seen(self.field, positions, directions)

    def _render(self, rays: Rays, jitter: Tensor, background: Tensor) -> Composited:
        field, cells, how, teacher = self.field, self.occupancy, self.sampling, self.teacher
        return render_batch(
            field, rays, cells, how, jitter=jitter, background=background, teacher=teacher
        )

    def optimisers(self) -> Optimisers:
        return {"adam": self.optimiser}

    def _update(self) -> None:
        loop.step_at(self.optimiser, self.learning_rate())

    def watched(self) -> Tensors:
        return dict(self.field.named_parameters())

    def result(self) -> Tensors:
        return self.field.state_dict(prefix="field.") | {"cells": self.occupancy.cells}

    def restore_result(self, tensors: Tensors) -> None:
        self.field.load_state_dict(checkpoint.part(tensors, "field."))


def _seen(field: Field, positions: Tensor, directions: Tensor) -> TwoTensors:
    """Opacity [S] over `REACH` and colour [S, 3] of points."""
    sigma, geometry = field.density(positions)
    colour = field.features(geometry, field.encode_directions(directions))[:, :3]
    return 1 - torch.exp(-sigma * REACH), colour

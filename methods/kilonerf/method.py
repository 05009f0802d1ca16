"""KiloNeRF (Reiser et al. 2021): thousands of small networks, distilled from one field, then
trained on photos (Section 3.2)."""

from dataclasses import dataclass
from typing import Annotated

import torch
from torch import Tensor
from torch.nn import functional

from bench.types import Budget, Scene, TwoTensors
from methods.instant_ngp.stage1 import TrainedField
from methods.kernels.settings import Count, NotNegative, between
from methods.kilonerf.field import Grid, KiloField, Pieces, place_networks
from methods.students.fields import FieldLessons, FieldStudent, StudentTraining
from methods.students.method import IN_FP32
from methods.training import checkpoint
from methods.training.checkpoint import Tensors

MOST = 32  # maximum number of networks along an axis: they are numbered in int16

LEAK = 0.01
"""Slope of the density below 0 in distillation: its gradient does not vanish in empty space."""


@dataclass(frozen=True)
class KiloLessons(FieldLessons):
    """How to train the networks, as `sweeps/configs/method/kilonerf.yaml` explains."""

    points_each: Count
    view_cost: NotNegative


class KiloTraining(StudentTraining):
    """Like `StudentTraining`, with the same number of points for each network."""

    options: KiloLessons
    field: KiloField
    pieces: Pieces

    def _places(self) -> Tensor:
        return self.pieces.draw(self.options.points_each, self.generator)

    def _learned(self, positions: Tensor, directions: Tensor) -> TwoTensors:
        """As in the base class, with a density that may fall below 0."""
        thickness, geometry = self.field.raw_density(positions)
        encoded = self.field.encode_directions(directions)
        opacity = 1 - torch.exp(-functional.leaky_relu(thickness, LEAK))
        return opacity, self.field.features(geometry, encoded)

    def _update(self) -> None:
        if self.step >= self.points_until:
            self._smooth_views()
        super()._update()

    @torch.no_grad()
    def _smooth_views(self) -> None:
        """Add the gradient of `view_cost` times the norms, not squared, of the layers that see the
        directions."""
        for name in ("direction", "colour"):
            for parameter in (self.field.weights[name], self.field.biases[name]):
                if parameter.grad is not None:
                    scale = self.options.view_cost / parameter.norm().clamp(min=1e-12)
                    parameter.grad.add_(parameter * scale)


@dataclass(kw_only=True, eq=False)
class KiloNerf(FieldStudent):
    """KiloNeRF as a `bench.types.Method`, with `networks` along the longest side of the scene, 1 to
    32."""

    training: KiloLessons
    networks: Annotated[int, between(1, MOST)]

    kind, model, computed = "kilonerf", ("networks",), IN_FP32

    def new_field(self) -> KiloField:
        """Make the networks of the grid that was placed or restored last."""
        teacher = self.teacher
        return KiloField(self.grid, teacher.backend, teacher.generator()).to(teacher.device)

    def begin(self, teacher: TrainedField, scene: Scene, budget: Budget) -> KiloTraining:
        bounds = scene.cells.to(self.teacher.device)
        self.occupancy = teacher.occupancy
        self.grid, pieces = place_networks(teacher.occupancy, bounds, self.networks)
        training = KiloTraining(self, teacher, scene, budget)
        training.pieces = pieces
        return training

    def restore(self, tensors: Tensors) -> None:
        parts = checkpoint.part(tensors, "field.")
        self.grid = Grid(parts["networks"], parts["corner"], parts["side"])
        super().restore(tensors)

"""Distillation of a field into the small networks, then training on photos (Section 3.2)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from bench.types import Budget, Scene
from methods.instant_ngp.stage1 import TrainedField
from methods.kernels.types import expect
from methods.kilonerf.field import KiloField
from methods.kilonerf.grid import Pieces
from methods.students.fields import FieldLessons, FieldStudent, StudentTraining

LEAK = 0.01
"""Slope of the density below 0 in distillation, so that its gradient does not vanish in empty
space."""


@dataclass(frozen=True)
class KiloLessons(FieldLessons):
    """How to train the networks; `rate` is below that of a hash grid.

    Attributes:
        points_each: points of each network in a step of the distillation.
        view_cost: weight of the norms of the layers that see directions, in training on rays.
    """

    rate: float = 3e-3
    final_rate: float = 1 / 30
    share: float = 1.0
    points_each: int = 128
    view_cost: float = 1e-6

    def __post_init__(self) -> None:
        super().__post_init__()
        expect(self.points_each >= 1, "points_each", "1 or more", self.points_each)
        expect(self.view_cost >= 0, "view_cost", "0 or more", self.view_cost)


class KiloTraining(StudentTraining):
    """Like `StudentTraining`, with the same number of points for each network."""

    options: KiloLessons

    def __init__(
        self,
        student: FieldStudent,
        field: KiloField,
        pieces: Pieces,
        trained: TrainedField,
        scene: Scene,
        budget: Budget,
    ) -> None:
        super().__init__(student, field, trained, scene, budget)
        self.networks, self.pieces = field, pieces

    def _places(self) -> tuple[Tensor, Tensor]:
        positions = self.pieces.draw(self.options.points_each, self.generator)
        directions = torch.randn(
            len(positions), 3, generator=self.generator, device=positions.device
        )
        return positions, functional.normalize(directions, dim=1)

    def _learned(self, positions: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """As in the base class, with a density that may fall below 0."""
        thickness, geometry = self.networks.raw_density(positions)
        encoded = self.networks.encode_directions(directions)
        opacity = 1 - torch.exp(-functional.leaky_relu(thickness, LEAK))
        return opacity, self.networks.features(geometry, encoded)

    def _update(self) -> None:
        if self.step >= self.points_until:
            self._smooth_views()
        super()._update()

    @torch.no_grad()
    def _smooth_views(self) -> None:
        """Add the gradient of `view_cost` times the norms, not squared, of the layers that see the
        directions (Section 3.2)."""
        for name in ("direction", "colour"):
            for parameter in (self.networks.weights[name], self.networks.biases[name]):
                if parameter.grad is not None:
                    scale = self.options.view_cost / parameter.norm().clamp(min=1e-12)
                    parameter.grad.add_(parameter * scale)

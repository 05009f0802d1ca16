"""KiloNeRF (Reiser et al. 2021): thousands of small networks, distilled from one field."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from bench.types import Budget, Scene
from methods.instant_ngp.stage1 import Setup, TrainedField
from methods.kilonerf.field import KiloField
from methods.kilonerf.grid import Grid, place_networks
from methods.kilonerf.training import KiloLessons, KiloTraining
from methods.students.fields import FieldStudent
from methods.training import checkpoint

MOST = 32
"""Maximum number of networks along an axis: they are numbered in int16."""


class KiloNerf(FieldStudent):
    """KiloNeRF as a `bench.types.Method`.

    Args:
        teacher: the field that it starts from, and where it runs.
        training: how the networks are trained.
        networks: how many there are along the longest side of the scene, 1 to 32.
        stop: transmittance at which a ray ends when rendering, less than 1.
        name: as shown in result rows.
        steps: steps of its own training; None: `budget.renderer_steps`.
    """

    kind = "kilonerf"
    training: KiloLessons

    def __init__(
        self,
        *,
        teacher: Setup,
        training: KiloLessons,
        networks: int = 16,
        stop: float = 1e-2,
        name: str = "kilonerf",
        steps: int | None = None,
    ) -> None:
        super().__init__(teacher, training, stop, name, steps)
        if not 1 <= networks <= MOST:
            raise ValueError(f"networks: expected 1 to {MOST} along an axis, got {networks}")
        self.networks = networks

    def model_settings(self) -> Mapping[str, object]:
        """See `Student`."""
        return {"networks": self.networks}

    def new_field(self) -> KiloField:
        """See `FieldStudent`; the grid is the one that was placed or restored last."""
        generator = torch.Generator().manual_seed(self.teacher.seed)
        return KiloField(self.grid, self.teacher.backend, generator).to(self.teacher.device)

    def begin(self, teacher: TrainedField, scene: Scene, budget: Budget) -> KiloTraining:
        """See `Student`."""
        bounds = scene.bounds.to(self.teacher.device)
        self.grid, pieces = place_networks(teacher.occupancy, bounds, self.networks)
        field, seed = self.new_field(), self.teacher.seed
        return KiloTraining(field, pieces, teacher, scene, budget, self.training, seed)

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """See `Student`."""
        parts = checkpoint.part(tensors, "field.")
        self.grid = Grid(parts["networks"], parts["corner"], parts["side"])
        super().restore(tensors)

"""KiloNeRF (Reiser et al. 2021): thousands of small networks, distilled from one field."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from bench.types import Budget, Scene
from methods.instant_ngp.stage1 import TrainedField
from methods.kernels.types import expect
from methods.kilonerf.field import KiloField
from methods.kilonerf.grid import Grid, place_networks
from methods.kilonerf.training import KiloLessons, KiloTraining
from methods.students.fields import FieldStudent
from methods.training import checkpoint

MOST = 32
"""Maximum number of networks along an axis: they are numbered in int16."""


@dataclass(kw_only=True, eq=False)
class KiloNerf(FieldStudent):
    """KiloNeRF as a `bench.types.Method`.

    Attributes:
        networks: how many there are along the longest side of the scene, 1 to 32.
    """

    training: KiloLessons
    name: str = "kilonerf"
    networks: int = 16

    kind = "kilonerf"

    def __post_init__(self) -> None:
        super().__post_init__()
        along = f"1 to {MOST} along an axis"
        expect(1 <= self.networks <= MOST, "networks", along, self.networks)

    def model_settings(self) -> Mapping[str, object]:
        """The number of networks."""
        return {"networks": self.networks}

    def new_field(self) -> KiloField:
        """Make the networks of the grid that was placed or restored last."""
        generator = torch.Generator().manual_seed(self.teacher.seed)
        return KiloField(self.grid, self.teacher.backend, generator).to(self.teacher.device)

    def begin(self, trained: TrainedField, scene: Scene, budget: Budget) -> KiloTraining:
        """Place the networks, and make their training."""
        bounds = scene.bounds.to(self.teacher.device)
        self.occupancy = trained.occupancy
        self.grid, pieces = place_networks(trained.occupancy, bounds, self.networks)
        return KiloTraining(self, self.new_field(), pieces, trained, scene, budget)

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Load the networks, and where they are."""
        parts = checkpoint.part(tensors, "field.")
        self.grid = Grid(parts["networks"], parts["corner"], parts["side"])
        super().restore(tensors)

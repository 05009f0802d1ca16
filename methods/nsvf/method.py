"""NSVF, as a `bench.types.Method`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Literal

import torch

from bench.types import Budget, Scene
from methods.instant_ngp.stage1 import Setup, TrainedField
from methods.kernels.encode import encode
from methods.kernels.types import BRICK, Occupancy
from methods.nsvf.field import EMBEDDING, NsvfField
from methods.rendering.occupancy import STEP
from methods.rendering.sampling import check_step
from methods.students.fields import FieldStudent, StudentTraining
from methods.students.networks import NetworkLessons
from methods.students.voxels import occupied_voxels

Start = Literal["random", "teacher"]


class Nsvf(FieldStudent):
    """A neural sparse voxel field whose voxels are where its teacher is occupied.

    Args:
        resolution: voxels along a side of the cube, a multiple of 16.
        step: length of a ray-marching step in voxels, in training and rendering.
        start: initial embeddings: "random", or the features of the "teacher" at their corners.
        others: see `Student`.
    """

    kind = "nsvf"

    def __init__(
        self,
        *,
        teacher: Setup,
        training: NetworkLessons,
        resolution: int = 128,
        step: float = 0.5,
        start: Start = "teacher",
        stop: float = 1e-2,
        name: str = "nsvf",
        steps: int | None = None,
    ) -> None:
        check_step("step", step)
        if resolution < 1 or resolution % BRICK**2:
            raise ValueError(f"resolution: expected a multiple of {BRICK**2}, got {resolution}")
        if start not in ("random", "teacher"):
            raise ValueError(f"start: expected random or teacher, got {start!r}")
        if start == "teacher" and teacher.grid.channels != EMBEDDING:
            raise ValueError(
                f"start=teacher: expected a grid of {EMBEDDING} channels (levels x features), got "
                f"{teacher.grid.channels}: use start=random"
            )
        training = replace(training, march_step=step / resolution / STEP)
        super().__init__(teacher, training, stop, name, steps)
        self.resolution, self.start = resolution, start

    def model_settings(self) -> Mapping[str, object]:
        """See `Student`."""
        return {"resolution": self.resolution, "start": self.start}

    def occupied(self, teacher: TrainedField) -> Occupancy:
        """See `FieldStudent`; its cells are the voxels."""
        size = self.resolution
        return Occupancy.at(occupied_voxels(teacher.occupancy, size), size)

    def new_field(self) -> NsvfField:
        """See `FieldStudent`."""
        teacher = self.teacher
        generator = torch.Generator().manual_seed(teacher.seed)
        field = NsvfField(self.occupancy, teacher.precision, teacher.backend, generator)
        return field.to(teacher.device)

    def begin(self, teacher: TrainedField, scene: Scene, budget: Budget) -> StudentTraining:
        """See `Student`."""
        training = super().begin(teacher, scene, budget)
        if self.start == "teacher" and isinstance(training.field, NsvfField):
            seen_at_corners(training.field, teacher)
        return training


@torch.no_grad()
def seen_at_corners(field: NsvfField, teacher: TrainedField) -> None:
    """Set every corner to the teacher's encoding at its position, in 1 / pi of the usual size of
    embeddings. The angles of the positional encoding then begin at that size and reach 32 times it,
    which is still smooth from corner to corner."""
    table = teacher.field
    places = field.vertices / len(field.index)
    found = encode(places, table.table, table.grid, packed=table.packed, backend=table.backend)
    spread = found.std() if found.numel() > 1 else found.new_ones(())
    size = EMBEDDING**-0.5 / math.pi
    field.embeddings.copy_(found * size / spread.clamp(min=1e-12))

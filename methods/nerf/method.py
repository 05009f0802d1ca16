"""NeRF, as a `bench.types.Method`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import torch

from bench.types import Probe
from methods.instant_ngp.stage1 import Setup
from methods.kernels.types import Occupancy
from methods.nerf.dense import every_sample, whole_cube
from methods.nerf.field import NerfField
from methods.rendering.frame import Render
from methods.students.fields import FieldStudent
from methods.students.networks import NetworkLessons


class Nerf(FieldStudent):
    """One NeRF network, rendered where its teacher is occupied, or everywhere.

    Args:
        skip: leave out the samples outside the occupied cells; the picture is the same.
        others: see `Student`.
    """

    kind = "nerf"
    study = replace(
        FieldStudent.study, skips={"empty cells": "method.skip"}, chosen=("skip", "stop")
    )

    def __init__(
        self,
        *,
        teacher: Setup,
        training: NetworkLessons,
        skip: bool = True,
        stop: float = 1e-2,
        name: str = "nerf",
        steps: int | None = None,
    ) -> None:
        super().__init__(teacher, training, stop, name, steps)
        self.skip = skip

    def model_settings(self) -> Mapping[str, object]:
        """See `Student`: none; the network is the published one."""
        return {}

    def new_field(self) -> NerfField:
        """See `FieldStudent`."""
        teacher = self.teacher
        generator = torch.Generator().manual_seed(teacher.seed)
        return NerfField(teacher.precision, teacher.backend, generator).to(teacher.device)

    def renderer(self, probe: Probe) -> tuple[Occupancy, Render]:
        """See `Student`."""
        if self.skip:
            return super().renderer(probe)
        cube = whole_cube(self.occupancy)
        return cube, every_sample(self.field, self.occupancy, cube, probe, self.march)

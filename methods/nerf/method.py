"""NeRF, as a `bench.types.Method`."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from bench.types import Probe
from methods.kernels.types import Occupancy
from methods.nerf.dense import every_sample
from methods.nerf.field import NerfField
from methods.rendering.frame import Render
from methods.students.fields import FieldStudent
from methods.students.networks import NetworkLessons


@dataclass(kw_only=True, eq=False)
class Nerf(FieldStudent):
    """One NeRF network, rendered where the field that it starts from is occupied, or everywhere.

    Attributes:
        skip: leave out the samples outside the occupied cells; the picture is the same.
    """

    training: NetworkLessons
    name: str = "nerf"
    skip: bool = True

    kind = "nerf"
    study = replace(
        FieldStudent.study, skips={"empty cells": "method.skip"}, chosen=("skip", "stop")
    )

    def new_field(self) -> NerfField:
        """Make the published network."""
        teacher = self.teacher
        generator = torch.Generator().manual_seed(teacher.seed)
        return NerfField(teacher.precision, teacher.backend, generator).to(teacher.device)

    def renderer(self, probe: Probe) -> tuple[Occupancy, Render]:
        """The occupied cells and a march through them, or the whole cube and every sample."""
        if self.skip:
            return super().renderer(probe)
        return every_sample(self.field, self.occupancy, probe, self.how)

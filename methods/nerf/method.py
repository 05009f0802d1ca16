"""NeRF, as a `bench.types.Method`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import torch

from bench.cameras import place_camera
from bench.study import Study, turned
from bench.types import Camera, Frame, Probe
from methods.instant_ngp.stage1 import Setup
from methods.kernels.composite import STOP
from methods.nerf.dense import every_sample, whole_cube
from methods.nerf.field import NerfField
from methods.rendering.frame import render_frame
from methods.students.fields import FieldStudent
from methods.students.networks import NetworkLessons


class Nerf(FieldStudent):
    """One NeRF network, rendered where its teacher found something, or everywhere.

    Args:
        skip: leave out the samples outside the occupied cells; the picture is the same.
        others: see `Student`.
    """

    kind = "nerf"
    study = Study(
        knobs={"stop": turned("stop", "method.stop", ("1e-1", "1e-2", "1e-3"))},
        exact=("method.stop=1e-4",),
        skips={"empty cells": "method.skip"},
        parts=dict.fromkeys(("rays", "march", "composite"), "field"),
    )

    def __init__(
        self,
        *,
        teacher: Setup,
        training: NetworkLessons,
        skip: bool = True,
        stop: float = STOP,
        name: str = "nerf",
        steps: int | None = None,
    ) -> None:
        super().__init__(teacher, training, stop, name, steps)
        self.training = training
        self.skip = skip

    def model_settings(self) -> Mapping[str, object]:
        """See `Student`: none, the network is the published one."""
        return {}

    def new_field(self) -> NerfField:
        """See `FieldStudent`."""
        teacher = self.teacher
        generator = torch.Generator().manual_seed(teacher.seed)
        return NerfField(teacher.precision, teacher.backend, generator).to(teacher.device)

    @torch.no_grad()
    def render(self, camera: Camera, probe: Probe) -> Frame:
        """One frame at the camera's full resolution."""
        if self.skip:
            return super().render(camera, probe)
        camera = place_camera(camera, self.teacher.device)
        march = replace(self.training.march, stop=self.stop)
        render = every_sample(self.field, self.occupancy, probe, march)
        cube = whole_cube(self.occupancy)
        frame = render_frame(self.field, camera, cube, self.background, probe, render)
        return Frame(frame.values, frame.depth, frame.alpha)

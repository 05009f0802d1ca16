"""NeRF, as a `bench.types.Method`."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from bench.types import Probe, Rays
from methods.kernels.composite import composite
from methods.kernels.march import march
from methods.kernels.types import Occupancy, Pixels
from methods.nerf.field import NerfField
from methods.rendering.field import query
from methods.rendering.frame import Renderer
from methods.students.fields import FieldLessons, FieldStudent

CHUNK_RAYS = 1 << 9
"""Rays whose samples are evaluated together: 200 MiB of outputs of a trunk of 256 channels."""


@dataclass(kw_only=True, eq=False)
class Nerf(FieldStudent):
    """One NeRF network, rendered where the field that it starts from is occupied, or everywhere."""

    training: FieldLessons
    skip: bool  # the samples outside the occupied cells; the picture is the same

    kind = "nerf"
    study = replace(
        FieldStudent.study, skips={"empty cells": "method.skip"}, chosen=("skip", "stop")
    )

    def new_field(self) -> NerfField:
        teacher = self.teacher
        field = NerfField(teacher.precision, teacher.backend, teacher.generator())
        return field.to(teacher.device)

    def renderer(self, probe: Probe) -> Renderer:
        """The occupied cells and a march through them, or the whole cube and every sample."""
        if self.skip:
            return super().renderer(probe)
        cube = self.occupancy.everywhere()

        def render(_: Tensor, rays: Rays) -> Pixels:
            canvas = Pixels.blank(len(rays.origins), self.field.channels, self.field.device)
            for part in torch.arange(len(rays.origins), device=self.field.device).split(CHUNK_RAYS):
                canvas.put(part, self._every_sample(rays.take(part), cube, probe))
            return canvas

        return cube, render

    def _every_sample(self, rays: Rays, cube: Occupancy, probe: Probe) -> Pixels:
        """Render as NeRF was published: density and colour of all samples in the cube. Those
        outside the occupied cells then count as empty, so that the picture is that of the march,
        except for the colours of samples too faint to be seen."""
        field, how = self.field, self.how
        with probe.stage("march"):
            samples = march(rays, cube, how.step, backend=field.backend)
        probe.count("samples", len(samples))
        probe.count("shaded_samples", len(samples), len(samples))
        field.count(probe, len(samples), len(samples))
        with probe.stage("field"):
            encoded = field.encode_directions(rays.directions)
            sigma, values = query(field, samples.positions, samples.ray, encoded)
            sigma = torch.where(self.occupancy.holds(samples.positions), sigma, 0)
        with probe.stage("composite"):
            return composite(sigma, values, samples, stop=how.stop, backend=field.backend)

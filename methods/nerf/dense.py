"""Rendering as NeRF was published: every sample of every ray, without skipping empty space."""

from __future__ import annotations

import torch
from torch import Tensor

from bench.types import Probe, Rays
from methods.kernels.composite import composite
from methods.kernels.march import march
from methods.kernels.types import Occupancy, Pixels
from methods.rendering.field import Field, query
from methods.rendering.frame import Render
from methods.rendering.sampling import Sampling

CHUNK_RAYS = 1 << 9
"""Rays whose samples are evaluated together: 200 MiB of outputs of a trunk of 256 channels."""


def every_sample(
    field: Field, occupancy: Occupancy, probe: Probe, how: Sampling
) -> tuple[Occupancy, Render]:
    """The whole cube, and the argument `render` of `render_frame` that evaluates density and colour
    of all samples in it.

    Samples outside the cells of `occupancy` then count as empty, so that the picture is that of
    `rendering.frame.everywhere`, except for the colours of samples too faint to be seen.
    """
    cube = Occupancy(torch.ones_like(occupancy.cells))

    def render(_: Tensor, rays: Rays) -> Pixels:
        canvas = Pixels.blank(len(rays.origins), field.channels, field.device)
        for part in torch.arange(len(rays.origins), device=field.device).split(CHUNK_RAYS):
            some = rays.take(part)
            with probe.stage("march"):
                samples = march(some, cube, how.step, backend=field.backend)
            probe.count("samples", len(samples))
            probe.count("shaded_samples", len(samples), len(samples))
            field.count(probe, len(samples), len(samples))
            with probe.stage("field"):
                encoded = field.encode_directions(some.directions)
                sigma, values = query(field, samples.positions, samples.ray, encoded)
                sigma = torch.where(occupancy.holds(samples.positions), sigma, 0)
            with probe.stage("composite"):
                pixels = composite(sigma, values, samples, stop=how.stop, backend=field.backend)
                canvas.put(part, pixels)
        return canvas

    return cube, render

"""Volume rendering of a field along rays: all samples at once to train, in rounds to render."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from bench.cameras import cast, pixel_grid, project
from bench.types import Camera, Probe, Rays
from methods.fields import HashField
from methods.kernels.composite import STOP, Pixels, composite, visible_counts
from methods.kernels.march import Occupancy, Samples, march
from methods.occupancy import STEP

CHUNK_RAYS = 1 << 14
"""Rays rendered together: their samples of a round should stay in the last-level cache."""

ROUND_SAMPLES = (4, 8, 16, 32)
"""Samples a ray may take in a round; the last number repeats."""

BATCH_QUANTUM = 1 << 11
"""Samples are handed to the field in multiples of this."""


def rays_at_matter(camera: Camera, occupancy: Occupancy) -> tuple[Tensor, Rays]:
    """The pixels that may see an occupied cell, as indices [P] row by row, and their rays.

    They are the pixels in the box around the projected corners of the occupied box; all of them
    when one of its corners is not in front of the camera.
    """
    device = camera.c2w.device
    corners = torch.cartesian_prod(*occupancy.bounds.to(device).T)
    corner_pixels, depth = project(camera, corners)
    size = torch.tensor((camera.width, camera.height), device=device)
    low, high = torch.zeros_like(size), size
    if (depth > 0).all():
        low = torch.minimum(corner_pixels.amin(dim=0).floor().clamp(min=0), size).long()
        high = torch.minimum(corner_pixels.amax(dim=0).ceil().clamp(min=0), size).long()
    width, height = (high - low).tolist()
    grid = pixel_grid(width, height, device) + low
    column, row = grid.long().unbind(dim=-1)
    return row * camera.width + column, cast(camera, grid)


def render_batch(
    field: HashField, rays: Rays, occupancy: Occupancy, jitter: Tensor, background: Tensor
) -> tuple[Pixels, int]:
    """Render `rays` differentiably; also the number of samples that took part.

    Samples behind the early stop, more than half of all once surfaces have formed, have neither
    weight nor gradient: the density of all samples, without gradient, tells which they are.

    Args:
        jitter: [R] phase of the samples of each ray, in [0, 1).
        background: [K] or [R, K].
    """
    samples = march(
        rays.origins, rays.directions, occupancy, STEP, jitter=jitter, backend=field.backend
    )
    with torch.no_grad():
        sigma, _ = field.density(_pad(samples.positions))
        sigma = sigma[: len(samples)]
        counts = visible_counts(sigma, samples.delta, samples.offsets, backend=field.backend)
    samples = samples.front(counts)
    sigma, values = _query(field, samples, rays.directions)
    pixels = composite(
        sigma,
        values,
        samples.t,
        samples.delta,
        samples.offsets,
        background=background,
        backend=field.backend,
    )
    return pixels, len(samples)


def _query(field: HashField, samples: Samples, directions: Tensor) -> tuple[Tensor, Tensor]:
    """Density [S] and features [S, K] of `samples` of rays along `directions` [R, 3].

    The field sees batches of a few round sizes only: the library behind the matrix products
    prepares code for every new size, which takes longer than the product itself.
    """
    sigma, geometry = field.density(_pad(samples.positions))
    values = field.features(geometry, field.encode_directions(directions)[_pad(samples.ray)])
    return sigma[: len(samples)], values[: len(samples)]


def _pad(samples: Tensor) -> Tensor:
    """Zeros at the end of [S, ...], up to a multiple of `BATCH_QUANTUM`."""
    padding = -len(samples) % BATCH_QUANTUM
    return functional.pad(samples, (0, 0) * (samples.dim() - 1) + (0, padding))


@dataclass
class _Canvas:
    """Pixels under construction, without background."""

    values: Tensor
    depth_sum: Tensor
    alpha: Tensor

    @classmethod
    def blank(cls, rays: int, channels: int, device: torch.device) -> _Canvas:
        return cls(
            torch.zeros(rays, channels, device=device),
            torch.zeros(rays, device=device),
            torch.zeros(rays, device=device),
        )

    def take(self, index: Tensor) -> Pixels:
        return Pixels(self.values[index], self.depth_sum[index], self.alpha[index])

    def put(self, index: Tensor, pixels: Pixels) -> None:
        self.values[index] = pixels.values
        self.depth_sum[index] = pixels.depth_sum
        self.alpha[index] = pixels.alpha


@torch.no_grad()
def render_rays(
    field: HashField, rays: Rays, occupancy: Occupancy, probe: Probe, *, stop: float = STOP
) -> Pixels:
    """Render `rays` in rounds, so that samples behind the early stop are hardly ever evaluated.

    Values are not composited onto a background. A round takes the next few samples of the rays
    that are still open, evaluates and composites them, and drops the rays that are done.
    """
    device = rays.origins.device
    canvas = _Canvas.blank(len(rays.origins), field.channels, device)
    for first in range(0, len(rays.origins), CHUNK_RAYS):
        alive = torch.arange(first, min(first + CHUNK_RAYS, len(rays.origins)), device=device)
        start = torch.zeros(len(alive), dtype=torch.int32, device=device)
        turn = 0
        while len(alive):
            limit = ROUND_SAMPLES[min(turn, len(ROUND_SAMPLES) - 1)]
            alive, start = _render_round(
                field, rays, occupancy, probe, canvas, alive, start, limit, stop
            )
            turn += 1
    return Pixels(canvas.values, canvas.depth_sum, canvas.alpha)


def _render_round(
    field: HashField,
    rays: Rays,
    occupancy: Occupancy,
    probe: Probe,
    canvas: _Canvas,
    alive: Tensor,
    start: Tensor,
    limit: int,
    stop: float,
) -> tuple[Tensor, Tensor]:
    """One round of the rays `alive` from their steps `start`; those left and where they go on."""
    with probe.stage("march"):
        origins, directions = rays.origins[alive], rays.directions[alive]
        samples = march(
            origins, directions, occupancy, STEP, start=start, limit=limit, backend=field.backend
        )
    probe.count("samples", len(samples))
    if len(samples) == 0:
        return alive[:0], start[:0]
    with probe.stage("field"):
        sigma, values = _query(field, samples, directions)
    with probe.stage("composite"):
        pixels = composite(
            sigma,
            values,
            samples.t,
            samples.delta,
            samples.offsets,
            stop=stop,
            carry=canvas.take(alive),
            backend=field.backend,
        )
        canvas.put(alive, pixels)
        left = (samples.resume >= 0) & (1 - pixels.alpha > stop)
        return alive[left], samples.resume[left]

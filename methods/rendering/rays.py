"""Volume rendering of frames. On a CPU rays take a few samples at a time and end early; on a GPU
all samples are taken at once, so that the host need not wait."""

from __future__ import annotations

import torch
from torch import Tensor

from bench.types import Probe, Rays
from methods.kernels.composite import composite, weights
from methods.kernels.march import extents, march
from methods.kernels.types import Occupancy, Pixels, Samples
from methods.rendering.compaction import compacts
from methods.rendering.field import CACHED_SAMPLES, CHUNK_SAMPLES, Field, pad, query
from methods.rendering.sampling import Sampling

CHUNK_RAYS = 1 << 16
"""Rays rendered together: enough to keep all threads busy, few enough to stay in the cache. This
also bounds the memory of a GPU, which holds all samples of these rays."""


@torch.no_grad()
def render_rays(
    field: Field,
    rays: Rays,
    occupancy: Occupancy,
    probe: Probe,
    how: Sampling,
    carry: Pixels | None = None,
) -> Pixels:
    """Render R `rays`. Values are not composited on a background.

    Args:
        carry: pixels of what lies in front of the windows of `how`; changed in place and returned.
    """
    device = rays.origins.device
    canvas = carry or Pixels.blank(len(rays.origins), field.channels, device)
    render = _in_rounds if compacts(device) else _at_once
    render(field, rays, occupancy, probe, how, canvas)
    return canvas


def _in_rounds(
    field: Field, rays: Rays, occupancy: Occupancy, probe: Probe, how: Sampling, canvas: Pixels
) -> None:
    """Render into `canvas` in rounds, so that few samples are evaluated behind the early stop.

    A round takes the next few samples of the rays that are still open, evaluates and composites
    them, and drops the rays that have ended. When fewer than half of the rays are left, each takes
    proportionally more samples.
    """
    device = rays.origins.device
    for first in range(0, len(rays.origins), CHUNK_RAYS):
        open_ = torch.arange(first, min(first + CHUNK_RAYS, len(rays.origins)), device=device)
        start = torch.zeros(len(open_), dtype=torch.int32, device=device)
        count = len(open_)
        while len(open_):
            with probe.stage("march"):
                some = rays.take(open_)
                samples = march(
                    some,
                    occupancy,
                    how.step,
                    window=None if how.window is None else how.window[open_],
                    start=start,
                    limit=field.round_samples * max(count // (2 * len(open_)), 1),
                    backend=field.backend,
                )
            probe.count("samples", len(samples))
            if not len(samples):
                break
            front = canvas.take(open_)
            sigma, values = _evaluated(field, samples, some.directions, front, how, probe)
            with probe.stage("composite"):
                pixels = composite(
                    sigma, values, samples, stop=how.stop, carry=front, backend=field.backend
                )
                canvas.put(open_, pixels)
                left = (samples.resume >= 0) & (1 - pixels.alpha > how.stop)
                left = left.nonzero().squeeze(1)
                open_, start = open_[left], samples.resume[left]


def _at_once(
    field: Field, rays: Rays, occupancy: Occupancy, probe: Probe, how: Sampling, canvas: Pixels
) -> None:
    """Render into `canvas` so that the host waits once, for the sample counts of all chunks.

    Every sample is evaluated, even if it is hidden or faint: only the GPU knows which are, and
    evaluating them takes less time than asking. So the work is that of a single round with all
    samples.
    """
    window, backend = how.window, field.backend
    with probe.stage("march"):
        sizes = extents(rays, occupancy, how.step, CHUNK_RAYS, window=window, backend=backend)
    for number, extent in enumerate(sizes):
        if not extent.total:
            continue
        chunk = slice(number * CHUNK_RAYS, (number + 1) * CHUNK_RAYS)
        with probe.stage("march"):
            some = rays.take(chunk)
            samples = march(
                some,
                occupancy,
                how.step,
                window=None if window is None else window[chunk],
                extent=extent,
                backend=backend,
            )
        probe.count("samples", extent.total)
        probe.count("shaded_samples", extent.total, extent.total)
        field.count(probe, extent.total, extent.total)
        front = canvas.take(chunk)
        with probe.stage("field"):
            encoded = field.encode_directions(some.directions)
            pieces = zip(
                samples.positions.split(CHUNK_SAMPLES),
                samples.ray.split(CHUNK_SAMPLES),
                strict=True,
            )
            found = [query(field, positions, ray, encoded) for positions, ray in pieces]
            sigma, values = (torch.cat(column) for column in zip(*found, strict=True))
            through = 1 - front.alpha
            weight = weights(sigma, samples, stop=how.stop, front=through, backend=backend)
            values = torch.where((weight > how.least_weight)[:, None], values, 0)
        with probe.stage("composite"):
            pixels = composite(sigma, values, samples, stop=how.stop, carry=front, backend=backend)
            canvas.put(chunk, pixels)


def _evaluated(
    field: Field, samples: Samples, directions: Tensor, front: Pixels, how: Sampling, probe: Probe
) -> tuple[Tensor, Tensor]:
    """Density [S] and features [S, K] of `samples` behind the pixels in `front`; features of faint
    samples are 0."""
    with probe.stage("field"):
        sigma, geometry = field.density(pad(samples.positions))
        sigma = sigma[: len(samples)]
        through = 1 - front.alpha
        weight = weights(sigma, samples, stop=how.stop, front=through, backend=field.backend)
        seen = (weight > how.least_weight).nonzero().squeeze(1)
        encoded = field.encode_directions(directions)
        values = sigma.new_zeros(len(samples), field.channels)
        for part in seen.split(CACHED_SAMPLES):
            index = pad(part)
            ray = samples.ray.index_select(0, index)
            shown = field.features(geometry.index_select(0, index), encoded.index_select(0, ray))
            values.index_copy_(0, part, shown[: len(part)])
    probe.count("shaded_samples", len(seen), len(samples))
    field.count(probe, len(samples), len(seen))
    return sigma, values

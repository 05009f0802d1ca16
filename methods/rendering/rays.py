"""Volume rendering of a field along rays, a few samples at a time: to render."""

from __future__ import annotations

import torch
from torch import Tensor

from bench.types import Probe, Rays
from methods.instant_ngp.field import HashField
from methods.kernels.composite import STOP, Pixels, composite, weights
from methods.kernels.march import Occupancy, march
from methods.rendering.batch import pad
from methods.rendering.occupancy import STEP

CHUNK_RAYS = 1 << 16
"""Rays rendered together: enough to keep all threads busy, few enough to stay in the cache."""

ROUND_SAMPLES = 6
"""Samples a ray may take in a round: more are evaluated in vain, fewer take more rounds. The few
rays that are left in the end are not worth many rounds: they may take as many more as they are
fewer than half of all."""

FAINT = 0.1
"""Samples of less weight than this share of the transmittance at which a ray may end have an
opacity, but no features: black instead, each changes a pixel by less than its weight, and so less
than a tenth of what may lie behind its end. A ray through haze has many of them."""


@torch.no_grad()
def render_rays(
    field: HashField,
    rays: Rays,
    occupancy: Occupancy,
    probe: Probe,
    *,
    stop: float = STOP,
    step: float = STEP,
    window: Tensor | None = None,
    carry: Pixels | None = None,
    faint: float | None = None,
) -> Pixels:
    """Render `rays` in rounds, so that samples behind the early stop are hardly ever evaluated.

    Values are not composited onto a background. A round takes the next few samples of the rays
    that are still open, evaluates and composites them, and drops the rays that are done.

    Args:
        window: [R, 2] nearest and farthest t of each ray; None: all.
        carry: what lies in front of the windows; taken over and changed in place.
        faint: samples of less weight have no features; None: `FAINT * stop`.
    """
    device = rays.origins.device
    faint = FAINT * stop if faint is None else faint
    canvas = carry or Pixels.blank(len(rays.origins), field.channels, device)
    for first in range(0, len(rays.origins), CHUNK_RAYS):
        alive = torch.arange(first, min(first + CHUNK_RAYS, len(rays.origins)), device=device)
        start = torch.zeros(len(alive), dtype=torch.int32, device=device)
        count = len(alive)
        while len(alive):
            limit = ROUND_SAMPLES * max(count // (2 * len(alive)), 1)
            alive, start = _render_round(
                field,
                rays,
                window,
                occupancy,
                probe,
                canvas,
                alive,
                start,
                limit,
                stop,
                step,
                faint,
            )
    return canvas


def _render_round(
    field: HashField,
    rays: Rays,
    window: Tensor | None,
    occupancy: Occupancy,
    probe: Probe,
    canvas: Pixels,
    alive: Tensor,
    start: Tensor,
    limit: int,
    stop: float,
    step: float,
    faint: float,
) -> tuple[Tensor, Tensor]:
    """One round of at most `limit` samples of the rays `alive` from their steps `start`; those left
    and where they go on."""
    with probe.stage("march"):
        round_rays = rays.take(alive)
        samples = march(
            round_rays,
            occupancy,
            step,
            window=None if window is None else window[alive],
            start=start,
            limit=limit,
            backend=field.backend,
        )
    probe.count("samples", len(samples))
    if len(samples) == 0:
        return alive[:0], start[:0]
    carry = canvas.take(alive)
    with probe.stage("field"):
        sigma, geometry = field.density(pad(samples.positions))
        sigma = sigma[: len(samples)]
        weight = weights(sigma, samples, stop=stop, front=1 - carry.alpha, backend=field.backend)
        seen = (weight > faint).nonzero().squeeze(1)
        encoded = field.encode_directions(round_rays.directions)
        index = pad(seen)
        values = sigma.new_zeros(len(samples), field.channels)
        shown = field.features(geometry[index], encoded[samples.ray[index]])
        values[seen] = shown[: len(seen)]
    probe.count("shaded_samples", len(seen), len(samples))
    field.count(probe, len(samples), len(seen))
    with probe.stage("composite"):
        pixels = composite(sigma, values, samples, stop=stop, carry=carry, backend=field.backend)
        canvas.put(alive, pixels)
        left = (samples.resume >= 0) & (1 - pixels.alpha > stop)
        return alive[left], samples.resume[left]

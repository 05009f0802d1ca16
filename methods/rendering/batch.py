"""Volume rendering to train: all samples of a batch of rays at once, with a gradient."""

from __future__ import annotations

import torch
from torch import Tensor

from bench.types import Rays
from methods.kernels.composite import Pixels, composite, visible_counts
from methods.kernels.march import Occupancy, march
from methods.rendering.field import CHUNK_SAMPLES, Field, pad, query
from methods.rendering.march import March


def render_batch(
    field: Field,
    rays: Rays,
    occupancy: Occupancy,
    how: March,
    *,
    jitter: Tensor | None = None,
    background: Tensor | None = None,
    guide: Field | None = None,
) -> tuple[Pixels, int]:
    """Render `rays`, R of them, differentiably; also the number of samples that took part.

    Samples behind the early stop, more than half of all once surfaces have formed, have neither
    weight nor gradient. A first pass finds them: it evaluates the density of all samples, without
    gradient.

    Args:
        how: `window` and `faint` are ignored.
        jitter: [R] phase of the samples of each ray, in [0, 1); None: as `rays.render_rays`.
        background: [K] or [R, K]; None: not composited on any.
        guide: a cheaper field whose densities tell in the first pass which samples are hidden, and
            so have neither weight nor gradient; None: `field` itself.
    """
    samples = march(rays, occupancy, how.step, jitter=jitter, backend=field.backend)
    with torch.no_grad():
        teller = field if guide is None else guide
        parts = pad(samples.positions).split(CHUNK_SAMPLES)
        sigma = torch.cat([teller.density(part)[0] for part in parts])[: len(samples)]
        counts = visible_counts(sigma, samples, stop=how.stop, backend=field.backend)
    samples = samples.front(counts)
    encoded = field.encode_directions(rays.directions)
    sigma, values = query(field, samples.positions, samples.ray, encoded)
    pixels = composite(sigma, values, samples, stop=how.stop, backend=field.backend)
    return pixels if background is None else pixels.over(background), len(samples)


def opacity_entropy(opacity: Tensor) -> Tensor:
    """Mean of -o ln o of `opacity` [R]: least where every ray meets all or nothing."""
    opacity = opacity.clamp(1e-5, 1 - 1e-5)
    return -(opacity * opacity.log()).mean()

"""Volume rendering in training: all samples of a batch of rays at once, with a gradient."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from bench.types import Rays
from methods.kernels.composite import Extent, Pixels, composite, visible_counts
from methods.kernels.march import Occupancy, Samples, march
from methods.rendering.compaction import compacts
from methods.rendering.field import CHUNK_SAMPLES, Field, pad, query
from methods.rendering.march import March

FRONT_SAMPLES = 8
"""Samples of a ray whose densities a CPU evaluates before it knows whether the ray goes on."""


KEPT_THIN = 4
"""One of so many thin samples is kept; see `render_batch`."""


@dataclass(frozen=True)
class FirstPass:
    """Samples of R rays, and which of them are visible before their rays end.

    Attributes:
        samples: visible or not; some that are not may be missing.
        sigma: [S] their density, without gradient.
        counts: [R] number of visible samples of each ray, which are its first ones.
    """

    samples: Samples
    sigma: Tensor
    counts: Tensor

    def opaque(self) -> Tensor:
        """Which rays have an opacity of more than 0, [R] bool."""
        thick = self.sigma * self.samples.delta > 0
        found = torch.zeros_like(self.counts, dtype=torch.int32)
        return found.scatter_reduce_(0, self.samples.ray.long(), thick.int(), "amax") > 0

    def thinned(self, thin: float, jitter: Tensor) -> Samples:
        """The visible samples, without most of the thin ones; see `render_batch`."""
        samples = self.samples
        place = torch.arange(len(samples), device=jitter.device)
        visible = place < (samples.offsets[:-1] + self.counts)[samples.ray]
        faint = self.sigma * samples.delta < thin
        # Digits of the phase that say nothing of where in a step the samples lie.
        turn = (jitter * 2**12).long() % KEPT_THIN
        kept = visible & ~(faint & ((place + turn[samples.ray]) % KEPT_THIN > 0))
        lengths = torch.where(faint, KEPT_THIN * samples.delta, samples.delta)
        return samples.where(kept, lengths)


def render_batch(
    field: Field,
    rays: Rays,
    occupancy: Occupancy,
    how: March,
    *,
    jitter: Tensor | None = None,
    background: Tensor | None = None,
    guide: Field | None = None,
    hidden: bool = False,
    thin: float = 0.0,
) -> tuple[Pixels, int]:
    """Render R `rays` differentiably; also return the number of samples that were composited.

    Samples behind the early stop, more than half of all once surfaces have formed, have neither
    weight nor gradient. A first pass finds them, and they are left out.

    Thin samples, which hardly show, can be left to chance: of those with an optical depth
    sigma delta below `thin`, one of `KEPT_THIN` is kept and gets the length of all. Where it lies
    depends on `jitter`, and the expected optical depth and its gradient stay the same.

    Args:
        how: `window` and `faint` are ignored.
        jitter: [R] phase of the samples of each ray, in [0, 1); None: as in `rays.render_rays`.
        background: [K] or [R, K]; None: pixels are not composited on a background.
        guide: a cheaper field whose densities decide in the first pass which samples are hidden,
            and so have neither weight nor gradient; None: `field` itself.
        hidden: evaluate hidden samples as well, so that the host need not wait for a GPU to count
            the others.
    """
    if hidden:
        samples = march(rays, occupancy, how.step, jitter=jitter, backend=field.backend)
    else:
        first = first_pass(field, rays, occupancy, how, jitter=jitter, guide=guide)
        if thin and jitter is not None:
            samples = first.thinned(thin, jitter)
        else:
            samples = first.samples.front(first.counts)
    pixels = second_pass(field, rays, samples, how)
    return pixels if background is None else pixels.over(background), len(samples)


@torch.no_grad()
def first_pass(
    field: Field,
    rays: Rays,
    occupancy: Occupancy,
    how: March,
    *,
    jitter: Tensor | None = None,
    extent: Extent | None = None,
    guide: Field | None = None,
) -> FirstPass:
    """Evaluate the density of the samples of `rays`; see `render_batch`.

    Args:
        extent: how many samples there are; None: the host waits for a GPU to count them.
    """
    teller = field if guide is None else guide
    if compacts(rays.origins.device):
        samples, sigma = _front_then_rest(teller, rays, occupancy, how, jitter, field.backend)
    else:
        samples = march(
            rays, occupancy, how.step, jitter=jitter, extent=extent, backend=field.backend
        )
        sigma = _densities(teller, samples)
    counts = visible_counts(sigma, samples, stop=how.stop, backend=field.backend)
    return FirstPass(samples, sigma, counts)


def _front_then_rest(
    teller: Field,
    rays: Rays,
    occupancy: Occupancy,
    how: March,
    jitter: Tensor | None,
    backend: str,
) -> tuple[Samples, Tensor]:
    """Samples and densities of `rays`; of rays that end within `FRONT_SAMPLES`, only so many."""
    front = march(rays, occupancy, how.step, jitter=jitter, limit=FRONT_SAMPLES, backend=backend)
    sigma = _densities(teller, front)
    seen = visible_counts(sigma, front, stop=how.stop, backend=backend)
    open_ = ((front.resume >= 0) & (seen == FRONT_SAMPLES)).nonzero().squeeze(1)
    rest = march(
        rays.take(open_),
        occupancy,
        how.step,
        jitter=None if jitter is None else jitter[open_],
        start=front.resume[open_],
        backend=backend,
    )
    samples, order = front.followed_by(rest, open_)
    return samples, torch.cat((sigma, _densities(teller, rest)))[order]


def _densities(field: Field, samples: Samples) -> Tensor:
    """Density of `samples`, [S]."""
    parts = pad(samples.positions).split(CHUNK_SAMPLES)
    return torch.cat([field.density(part)[0] for part in parts])[: len(samples)]


def second_pass(field: Field, rays: Rays, samples: Samples, how: March) -> Pixels:
    """Composite the `samples` of `rays`, with a gradient."""
    encoded = field.encode_directions(rays.directions)
    sigma, values = query(field, samples.positions, samples.ray, encoded)
    return composite(sigma, values, samples, stop=how.stop, backend=field.backend)


def opacity_entropy(opacity: Tensor) -> Tensor:
    """Mean of -o ln o of `opacity` [R]: smallest when every ray is fully opaque or empty."""
    opacity = opacity.clamp(1e-5, 1 - 1e-5)
    return -(opacity * opacity.log()).mean()

"""Volume rendering in training: all samples of a batch of rays at once, with a gradient."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from bench.types import Rays
from methods.kernels.composite import Extent, Pixels, composite, visible
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
        samples: those at the front of each ray, or all of them.
        sigma: [S] their density, without gradient.
        counts: [R] number of visible ones of each ray, which are its first ones.
        rest: the rays [Q] that go on behind these samples, and what follows on them; None: none do.
    """

    samples: Samples
    sigma: Tensor
    counts: Tensor
    rest: tuple[Tensor, FirstPass] | None = None

    def opaque(self) -> Tensor:
        """Which rays have an opacity of more than 0, [R] bool."""
        thick = self.sigma * self.samples.delta > 0
        found = torch.zeros_like(self.counts, dtype=torch.int32)
        found.scatter_reduce_(0, self.samples.ray.long(), thick.int(), "amax")
        if self.rest is not None:
            rays, behind = self.rest
            found.index_add_(0, rays, behind.opaque().int())
        return found > 0

    def visible(self, extent: Extent | None = None) -> Samples:
        """The visible samples. `extent` is theirs; None: the host waits for a GPU."""
        front = self.samples.front(self.counts, extent)
        if self.rest is None:
            return front
        rays, behind = self.rest
        return front.followed_by(behind.visible(), rays)

    def thinned(self, thin: float, jitter: Tensor) -> Samples:
        """The visible samples, without most of the thin ones; see `render_batch`."""
        # Digits of the phase that say nothing of where in a step the samples lie.
        return self._in_turn(thin, (jitter * 2**12).int())

    def _in_turn(self, thin: float, turn: Tensor) -> Samples:
        """`thinned`; of the thin samples of a ray, numbered from its `turn` [R] on, every
        `KEPT_THIN`-th is kept."""
        samples, counts = self.samples, self.counts.int()
        first = samples.offsets[:-1].int()
        # For each sample: the number at which the visible samples of its ray end, and what its own
        # number lacks to its turn.
        end = (first + counts).index_select(0, samples.ray)
        shift = (turn - first).index_select(0, samples.ray)
        number = torch.arange(len(samples), dtype=torch.int32, device=turn.device)
        faint = self.sigma * samples.delta < thin
        kept = (number < end) & ~(faint & ((number + shift) % KEPT_THIN > 0))
        lengths = torch.where(faint, KEPT_THIN * samples.delta, samples.delta)
        front = samples.where(kept, lengths)
        if self.rest is None:
            return front
        rays, behind = self.rest
        return front.followed_by(behind._in_turn(thin, (turn + counts)[rays]), rays)


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
    depends on `jitter`, and the expected optical depth and its gradient stay the same. Without
    `jitter`, or with `hidden` samples, none are left out.

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
        kept = None if jitter is None or not thin else first.thinned(thin, jitter)
        samples = first.visible() if kept is None else kept
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
    # On a CPU most rays end soon: only those that do not are looked at further.
    limit = FRONT_SAMPLES if compacts(rays.origins.device) else None
    samples = march(
        rays,
        occupancy,
        how.step,
        jitter=jitter,
        limit=limit,
        extent=extent,
        backend=field.backend,
    )
    sigma = _densities(teller, samples)
    counts, left = visible(sigma, samples, stop=how.stop, backend=field.backend)
    if limit is None:
        return FirstPass(samples, sigma, counts)
    open_ = ((samples.resume >= 0) & (left > how.stop)).nonzero().squeeze(1)
    behind = march(
        rays.take(open_),
        occupancy,
        how.step,
        jitter=None if jitter is None else jitter[open_],
        start=samples.resume[open_],
        backend=field.backend,
    )
    dense = _densities(teller, behind)
    seen, _ = visible(dense, behind, stop=how.stop, front=left[open_], backend=field.backend)
    return FirstPass(samples, sigma, counts, (open_, FirstPass(behind, dense, seen)))


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

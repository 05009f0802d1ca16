"""Volume rendering in training: all samples of a batch of rays at once, with a gradient."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from bench.types import Rays
from methods.kernels.composite import composite, visible
from methods.kernels.march import march
from methods.kernels.types import Extent, Occupancy, Pixels, Samples
from methods.rendering.compaction import compacts
from methods.rendering.field import CACHED_SAMPLES, CHUNK_SAMPLES, Encoder, Field, pad, query
from methods.rendering.sampling import Sampling

FIRST_ROUNDS = (8, 16)
"""How many samples of a ray a CPU evaluates in each of the first rounds, before it knows whether
the ray goes on; a last round has all that are left."""

KEPT_THIN = 4
"""One of so many thin samples is kept; see `render_batch`."""


@dataclass(frozen=True)
class Round:
    """The next samples of some rays, and which of them are visible before their rays end.

    Attributes:
        rays: [Q] which rays these are; None: all.
        samples: their samples.
        sigma: [S] density of these, without gradient.
        counts: [Q] number of visible ones of each ray, which are its first ones.
    """

    rays: Tensor | None
    samples: Samples
    sigma: Tensor
    counts: Tensor

    @property
    def ray(self) -> Tensor:
        """[S] int32, the ray that a sample belongs to, among all rays."""
        own = self.samples.ray
        return own if self.rays is None else self.rays.int().index_select(0, own)

    def place(self, of_each: Tensor, values: Tensor) -> None:
        """Write the `values` [Q] of these rays into `of_each` [R], which has one of every ray."""
        if self.rays is None:
            of_each.copy_(values)
        else:
            of_each.index_copy_(0, self.rays, values)


@dataclass(frozen=True)
class FirstPass:
    """The `rounds` in which the samples of R rays were looked at; on a GPU, there is one."""

    rounds: list[Round]

    @property
    def counts(self) -> Tensor:
        """[R] number of visible samples of each ray."""
        return self._seen()[-1]

    def opaque(self) -> Tensor:
        """Which rays have an opacity of more than 0, [R] bool."""
        found = torch.zeros_like(self.rounds[0].counts, dtype=torch.int32)
        for some in self.rounds:
            thick = some.sigma * some.samples.delta > 0
            found.scatter_reduce_(0, some.ray.long(), thick.int(), "amax")
        return found > 0

    def visible(self, extent: Extent | None = None) -> Samples:
        """The visible samples. `extent` is theirs; None: the host waits for a GPU."""
        front = self.rounds[0]
        if len(self.rounds) == 1:
            return front.samples.front(front.counts, extent)
        return self._kept(0.0, torch.zeros_like(front.samples.resume))

    def thinned(self, thin: float, jitter: Tensor) -> Samples:
        """The visible samples, without most of the thin ones; see `render_batch`."""
        # Digits of the phase that say nothing of where in a step the samples lie.
        return self._kept(thin, (jitter * 2**12).int())

    def _kept(self, thin: float, turns: Tensor) -> Samples:
        """The visible samples, numbered along each ray from its turn [R] on. Of those below the
        optical depth `thin`, the ones stay whose number `KEPT_THIN` divides, with the length of
        all."""
        together = self._together()
        delta = together.delta
        faint = torch.cat([some.sigma for some in self.rounds]) * delta < thin
        numbers, visible = self._numbered(turns)
        index = (visible & (~faint | (numbers % KEPT_THIN == 0))).nonzero().squeeze(1)
        ray = together.ray.index_select(0, index)
        counts = torch.zeros_like(self.rounds[0].counts)
        counts.index_add_(0, ray, torch.ones_like(index))
        offsets = torch.cat((counts.new_zeros(1), counts.cumsum(dim=0)))
        longest = together.longest if len(self.rounds) == 1 else None  # it has no more
        lengths = torch.where(faint, KEPT_THIN * delta, delta)
        # Those of a ray lie in memory in their order, round after round.
        index = index.index_select(0, ray.argsort(stable=True))
        return replace(together, delta=lengths).chosen(index, offsets, longest)

    def _numbered(self, turns: Tensor) -> tuple[Tensor, Tensor]:
        """The number of each sample of all rounds on its ray, from its turn [R] on, and whether it
        is visible; [S] each. Only the visible ones are counted."""
        numbers, visible = [], []
        for some, seen in zip(self.rounds, self._seen(), strict=False):
            own = some.samples.ray
            number = torch.arange(len(own), device=own.device)
            number -= some.samples.offsets.index_select(0, own)
            visible.append(number < some.counts.index_select(0, own))
            numbers.append(number + (turns + seen).index_select(0, some.ray))
        return torch.cat(numbers), torch.cat(visible)

    def _seen(self) -> list[Tensor]:
        """How many visible samples each ray has before each round, and after the last: [R] each."""
        seen = [torch.zeros_like(self.rounds[0].counts)]
        for some in self.rounds:
            of_round = torch.zeros_like(seen[0])
            some.place(of_round, some.counts)
            seen.append(seen[-1] + of_round)
        return seen

    def _together(self) -> Samples:
        """The samples of all rounds, one round after the other. `offsets`, `resume` and `longest`
        are those of the first."""
        every = [some.samples for some in self.rounds]
        if len(every) == 1:
            return every[0]
        encoded = [samples.encoded for samples in every if samples.encoded is not None]
        return replace(
            every[0],
            t=torch.cat([samples.t for samples in every]),
            delta=torch.cat([samples.delta for samples in every]),
            ray=torch.cat([some.ray for some in self.rounds]),
            positions=torch.cat([samples.positions for samples in every]),
            encoded=torch.cat(encoded) if encoded else None,
        )


def render_batch(
    field: Field,
    rays: Rays,
    occupancy: Occupancy,
    how: Sampling,
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
    how: Sampling,
    *,
    jitter: Tensor | None = None,
    extent: Extent | None = None,
    guide: Field | None = None,
) -> FirstPass:
    """Evaluate the density of the samples of `rays`; see `render_batch`.

    Args:
        extent: how many samples there are, only on a GPU; None: the host waits to count them.
    """
    # Most rays end soon; a CPU looks further only along the others.
    limits = FIRST_ROUNDS if compacts(rays.origins.device) else ()
    rounds: list[Round] = []
    chosen, start, front = None, None, None
    for limit in (*limits, None):
        samples = march(
            rays if chosen is None else rays.take(chosen),
            occupancy,
            how.step,
            jitter=jitter if jitter is None or chosen is None else jitter[chosen],
            start=start,
            limit=limit,
            extent=extent,
            backend=field.backend,
        )
        if guide is None and isinstance(field, Encoder):
            sigma, samples = _encoded_densities(field, samples)
        else:
            sigma = _densities(field if guide is None else guide, samples)
        counts, left = visible(sigma, samples, stop=how.stop, front=front, backend=field.backend)
        rounds.append(Round(chosen, samples, sigma, counts))
        if limit is None:
            break
        going = ((samples.resume >= 0) & (left > how.stop)).nonzero().squeeze(1)
        if not len(going):
            break
        chosen = going if chosen is None else chosen[going]
        start, front = samples.resume[going], left[going]
    return FirstPass(rounds)


def _densities(field: Field, samples: Samples) -> Tensor:
    """Density of `samples`, [S]."""
    parts = pad(samples.positions).split(CHUNK_SAMPLES)
    return torch.cat([field.density(part)[0] for part in parts])[: len(samples)]


def _encoded_densities(field: Encoder, samples: Samples) -> tuple[Tensor, Samples]:
    """Density of `samples`, [S], and the samples with the encoding of their positions."""
    size = CACHED_SAMPLES if compacts(samples.t.device) else CHUNK_SAMPLES
    parts = pad(samples.positions).split(size)
    encoded, sigma = [], []
    for part in parts:
        encoded.append(field.encode(part))
        sigma.append(field.density(part, encoded[-1])[0])
    known = torch.cat(encoded)[: len(samples)]
    return torch.cat(sigma)[: len(samples)], replace(samples, encoded=known)


def second_pass(field: Field, rays: Rays, samples: Samples, how: Sampling) -> Pixels:
    """Composite the `samples` of `rays`, with a gradient."""
    directions = field.encode_directions(rays.directions)
    sigma, values = query(field, samples.positions, samples.ray, directions, samples.encoded)
    return composite(sigma, values, samples, stop=how.stop, backend=field.backend)


def opacity_entropy(opacity: Tensor) -> Tensor:
    """Mean of -o ln o of `opacity` [R]: smallest when every ray is fully opaque or empty."""
    opacity = opacity.clamp(1e-5, 1 - 1e-5)
    return -(opacity * opacity.log()).mean()

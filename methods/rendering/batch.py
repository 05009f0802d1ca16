"""Volume rendering in training: all samples of a batch of rays at once, with a gradient."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from bench.types import Rays
from methods.kernels.composite import composite, visibility
from methods.kernels.march import march
from methods.kernels.march.contraction import HALF
from methods.kernels.types import Composited, Occupancy, Samples, cat, offsets_of
from methods.rendering.compaction import compacts
from methods.rendering.field import CACHED_SAMPLES, CHUNK_SAMPLES, Encoder, Field, pad, query
from methods.rendering.sampling import Sampling

FIRST_ROUNDS = (8, 16)
"""How many samples of a ray a CPU evaluates in each of the first rounds, before it knows whether
the ray goes on; a last round has all that are left."""

NEAR = HALF / 2
"""Distance from a camera below which gradients fall with its square, where space has no end. With
half of it, two captures are 0.2 to 0.3 dB better than with twice of it, and a third worse."""

KEPT_THIN = 4  # one of so many thin samples is kept, with the length of all


def render_batch(
    field: Field,
    rays: Rays,
    occupancy: Occupancy,
    how: Sampling,
    *,
    jitter: Tensor | None = None,
    background: Tensor | None = None,
    teacher: Field | None = None,
) -> Composited:
    """Render R `rays` differentiably; also return the number of samples that were composited.

    Samples behind the early stop, more than half of all once surfaces have formed, have neither
    weight nor gradient. A first pass finds them, and they are left out.

    Args:
        how: `window` is ignored; without `jitter`, `thin` is as well.
        jitter: [R] phase of the samples of each ray, in [0, 1); None: as in `frame.render_rays`.
        background: [K] or [R, K]; None: pixels are not composited on a background.
        teacher: a cheaper field whose densities decide in the first pass which samples are hidden,
            and so have neither weight nor gradient; None: `field` itself.
    """
    samples = visible_samples(field, rays, occupancy, how, jitter=jitter, teacher=teacher)
    directions = field.encode_directions(rays.directions)
    sigma, values = query(field, samples.positions, samples.ray, directions, samples.encoded)
    if occupancy.contracted and sigma.requires_grad:
        # Near a camera a sample is met by many rays of one picture, and learns fog before the lens
        # from their sum; in proportion to the squared distance, all samples learn alike (Philip and
        # Deschaintre 2023, "Floaters No More").
        away = samples.t * rays.directions.norm(dim=1).index_select(0, samples.ray)
        share = (away / NEAR).square().clamp(max=1)
        sigma.register_hook(lambda gradient: gradient * share)
        values.register_hook(lambda gradient: gradient * share[:, None])
    pixels = composite(sigma, values, samples, stop=how.stop, backend=field.backend)
    return pixels if background is None else pixels.over(background), len(samples)


@dataclass(frozen=True)
class Round:
    """The next samples of the rays `chosen`, their density [S], and how many of each ray, its first
    ones, are visible: `counts` [Q]."""

    chosen: Tensor | slice
    samples: Samples
    sigma: Tensor
    counts: Tensor


@torch.no_grad()
def visible_samples(
    field: Field,
    rays: Rays,
    occupancy: Occupancy,
    how: Sampling,
    *,
    jitter: Tensor | None = None,
    teacher: Field | None = None,
) -> Samples:
    """The samples of `rays` that are visible, without most of the thin ones; the arguments are
    those of `render_batch`. The host waits for a GPU to count them."""
    # Most rays end soon; a CPU looks further only along the others.
    limits = FIRST_ROUNDS if compacts(rays.origins.device) else ()
    rounds: list[Round] = []
    chosen: Tensor | slice = slice(None)
    start, front = None, None
    for limit in (*limits, None):
        samples = march(
            rays.take(chosen),
            occupancy,
            how.step,
            jitter=None if jitter is None else jitter[chosen],
            start=start,
            limit=limit,
            backend=field.backend,
        )
        if teacher is None and isinstance(field, Encoder):
            sigma, samples = _encoded_densities(field, samples)
        else:
            parts = pad(samples.positions).split(CHUNK_SAMPLES)
            judge = field if teacher is None else teacher
            sigma = cat([judge.density(part)[0] for part in parts])[: len(samples)]
        seen = visibility(sigma, samples, stop=how.stop, front=front, backend=field.backend)
        counts, left = seen.counts, seen.left
        rounds.append(Round(chosen, samples, sigma, counts))
        if limit is None:
            break
        going = ((samples.resume >= 0) & (left > how.stop)).nonzero().squeeze(1)
        if not len(going):
            break
        chosen = going if isinstance(chosen, slice) else chosen[going]
        start, front = samples.resume[going], left[going]
    if jitter is None or not how.thin:
        if len(rounds) == 1:
            return samples.front(counts)
        return thinned(rounds, 0.0, torch.zeros_like(rounds[0].counts))
    # Digits of the phase that say nothing of where in a step the samples lie.
    return thinned(rounds, how.thin, (jitter * 2**12).long())


def _encoded_densities(field: Encoder, samples: Samples) -> tuple[Tensor, Samples]:
    """Density of `samples`, [S], and the samples with the encoding of their positions."""
    size = CACHED_SAMPLES if compacts(samples.t.device) else CHUNK_SAMPLES
    encoded, sigma = [], []
    for part in pad(samples.positions).split(size):
        encoded.append(field.encode(part))
        sigma.append(field.density(part, encoded[-1])[0])
    known = cat(encoded)[: len(samples)]
    return cat(sigma)[: len(samples)], replace(samples, encoded=known)


def thinned(rounds: list[Round], thin: float, turns: Tensor) -> Samples:
    """The visible samples, numbered along each ray from its turn [R] on. Of those below the optical
    depth `thin`, the ones stay whose number `KEPT_THIN` divides, with the length of all."""
    numbers, shown, of_ray = [], [], []
    for some in rounds:
        own, chosen = some.samples.ray, some.chosen
        number = torch.arange(len(own), device=own.device)
        number -= some.samples.offsets.index_select(0, own)
        shown.append(number < some.counts.index_select(0, own))
        numbers.append(number + turns[chosen].index_select(0, own))
        of_ray.append(own if isinstance(chosen, slice) else chosen.int().index_select(0, own))
        if some is not rounds[-1]:
            turns[chosen] += some.counts  # all samples of a ray that goes on are visible
    every = [some.samples for some in rounds]
    delta, ray = cat([samples.delta for samples in every]), cat(of_ray)
    faint = cat([some.sigma for some in rounds]) * delta < thin
    index = cat(shown) & (~faint | (cat(numbers) % KEPT_THIN == 0))
    index = index.nonzero().squeeze(1)
    ray_of_kept = ray.index_select(0, index)
    counts = torch.zeros_like(turns).index_add_(0, ray_of_kept, torch.ones_like(index))
    encoded = [samples.encoded for samples in every if samples.encoded is not None]
    together = replace(
        every[0],
        t=cat([samples.t for samples in every]),
        delta=torch.where(faint, KEPT_THIN * delta, delta),
        ray=ray,
        positions=cat([samples.positions for samples in every]),
        encoded=cat(encoded) if encoded else None,
    )
    if len(rounds) == 1:  # its samples lie in memory ray by ray, and no ray has more
        return together.chosen(index, offsets_of(counts), every[0].longest)
    # Those of a ray lie in memory in their order, round after round.
    in_order = index.index_select(0, ray_of_kept.argsort(stable=True))
    return together.chosen(in_order, offsets_of(counts), None)


def opacity_entropy(opacity: Tensor) -> Tensor:
    """Mean of -o ln o of `opacity` [R]: smallest when every ray is fully opaque or empty."""
    opacity = opacity.clamp(1e-5, 1 - 1e-5)
    return -(opacity * opacity.log()).mean()

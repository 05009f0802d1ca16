"""Cases of the compositing: agreement of the backends, extremes, long rays, invariances."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from bench.case import (
    DTYPES,
    U32,
    Bound,
    Case,
    Given,
    Operation,
    Property,
    largest_error,
    on_backends,
)
from methods.kernels.composite import composite, visible, weights
from methods.kernels.dispatch import served
from methods.kernels.types import Intervals, Pixels

INF = math.inf

DEPTH = 2.0
"""Largest t of the samples; values and gradients of pixels are at most 1."""


@dataclass(frozen=True)
class Kind:
    """Inputs of an agreement: `rays` of up to `most` samples."""

    rays: int
    most: int
    channels: int = 3
    density: float = 2.0
    carry: bool = False
    stop: float = 0.0


KINDS = {
    "no ray": Kind(0, 0),
    "rays without samples": Kind(5, 0),
    "one sample a ray": Kind(7, 1),
    "1024 samples a ray": Kind(3, 1024),
    "ragged rays": Kind(101, 37),
    "nine channels": Kind(33, 20, channels=9),
    "no density": Kind(9, 12, density=0.0),
    "opaque at once": Kind(9, 12, density=1e30),
    "continued": Kind(33, 20, carry=True),
    # A ray could end a sample earlier only if its transmittance, one in 10^6, is within rounding
    # of `stop`.
    "stopped after a few samples": Kind(40, 12, stop=0.3),
    "stopped after many samples": Kind(20, 200, stop=0.3),
    "continued and stopped": Kind(33, 20, carry=True, stop=0.3),
}

TIMED = Kind(1 << 12, 64)

LIGHT = (
    "a transmittance T = exp(-tau), tau a sum of n, or a product of n, is off by (n + 8) T tau u "
    "in each backend, T tau < 1"
)


@dataclass(frozen=True)
class Bundle:
    """Samples of R rays, of which each has `counts` [R]."""

    sigma: Tensor
    values: Tensor
    t: Tensor
    delta: Tensor
    counts: Tensor

    def apply(self, change: Callable[[Tensor], Tensor]) -> Bundle:
        """The bundle with all numbers of samples changed."""
        return replace(self, **{name: change(getattr(self, name)) for name in PER_SAMPLE})

    @property
    def intervals(self) -> Intervals:
        """Where the samples lie."""
        return Intervals(self.t, self.delta, pad(self.counts.cumsum(0), (1, 0)))

    def composite(self, backend: str, carry: Pixels | None = None, stop: float = 0.0) -> Pixels:
        """The pixels of the rays, without a background."""
        given = self.sigma, self.values, self.intervals
        return composite(*given, stop=stop, carry=carry, backend=backend)

    def to(self, device: str) -> Bundle:
        """The bundle on another device."""
        return replace(self.apply(lambda x: x.to(device)), counts=self.counts.to(device))

    def rays(self, order: Tensor) -> Bundle:
        """The rays at `order`, with their samples."""
        counts = self.counts.tolist()
        chosen = self.apply(lambda x: torch.cat([x.split(counts)[i] for i in order.tolist()]))
        return replace(chosen, counts=self.counts[order])


PER_SAMPLE = ("sigma", "values", "t", "delta")

Change = Callable[[Bundle, str], tuple[Pixels, Pixels]]

EXTREMES = {
    "density 0": (0.0, 0.1),
    "density 1e-30": (1e-30, 0.1),
    "density 1e30": (1e30, 0.1),
    "density infinite": (INF, 0.1),
    "density exp(100)": (math.exp(100), 0.1),
    "density exp(-100)": (math.exp(-100), 0.1),
    "length 0": (2.0, 0.0),
    "length 0, density infinite": (INF, 0.0),
    "length 1e-30": (2.0, 1e-30),
    "length 1e10": (2.0, 1e10),
    "density times length overflows": (1e30, 1e10),
    "density times length underflows": (1e-30, 1e-30),
}
"""Density and length of one sample."""

LENGTHS = (1, 64, 1024, 65536)

RAY = (
    "a weight has 4 roundings, what is in front 1, a sum of n in pairs log2 n: (8 + log2 n) u; in "
    "fp64, where nothing wider is there to sum thicknesses in, n u more"
)
SAME = "a sum in another order: twice (8 + log2 n) u; the compiled one has no order to choose: 0"


def cases() -> list[Case]:
    """One extreme sample among ordinary ones; sums of weights on long rays; invariances."""
    pixels = Property(
        "composite",
        "pixels are those of the closed form",
        "8 samples: a weight has 4 roundings, thickness in front and sum 9; values up to 2: 32 u",
        on_backends(32, "fp64", "fp16", "bf16"),
    )
    gradients = Property(
        "composite backward",
        "gradients are finite and those of the closed form",
        "as of a pixel, by the length of the sample; behind it, as many again: 64 u",
        on_backends(64, "fp64"),
    )
    found = _agreements()
    for name, extreme in EXTREMES.items():
        found.append(pixels.case(name, partial(_pixel_error, extreme)))
        found.append(gradients.case(name, partial(_gradient_error, extreme)))
    for count in LENGTHS:
        units = 8 + math.log2(count)
        light = Property(
            "transmittance",
            "weights and what is left add up to 1",
            RAY,
            on_backends(units) | {("reference", "fp64"): (units + count) * 2**-53},
        )
        for kind in ("thin", "opaque", "alternating"):
            name = f"{count:,} samples, {kind}"
            found.append(light.case(name, partial(_light_error, count, kind)))
    for name, changed, holds, derivation, cells in CHANGES:
        change = Property("composite", holds, derivation, cells)
        found.append(change.case(name, partial(_change_error, changed)))
    return found


def _agreements() -> list[Case]:
    found = []
    for name, kind in KINDS.items():
        for operation in (COMPOSITE, WEIGHTS, VISIBLE):
            found += operation.cases(name, partial(_given, kind))
    return [*found, *COMPOSITE.cases("64 samples a ray", partial(_given, TIMED), items=1 << 18)]


def _given(kind: Kind) -> Given:
    generator = torch.Generator().manual_seed(kind.rays + kind.most)
    rays, channels = kind.rays, kind.channels
    draw = partial(torch.rand, generator=generator)
    counts = torch.randint(0, kind.most + 1, (rays,), generator=generator)
    if kind == Kind(rays, kind.most):
        counts[: rays // 2] = kind.most  # make sure that longest rays occur
    total = int(counts.sum())
    alpha = draw(rays)
    carry = Pixels(alpha[:, None].expand(rays, channels), DEPTH * alpha, alpha)
    return {
        "sigma": kind.density * draw(total),
        "values": draw(total, channels),
        "t": DEPTH * draw(total),
        "delta": DEPTH / max(kind.most, 1) * draw(total),
        "counts": counts,
        "carry": carry if kind.carry else None,
        "kind": kind,
    }


def _bundle(given: Given) -> Bundle:
    return Bundle(*(given[name] for name in (*PER_SAMPLE, "counts")))


def _composite(given: Given, backend: str) -> tuple[Tensor, ...]:
    pixels = _bundle(given).composite(backend, given["carry"], given["kind"].stop)
    return pixels.values, pixels.depth_sum, pixels.alpha


def _lit(given: Given, backend: str) -> dict[str, Any]:
    """The optional arguments of `weights` and `visible`."""
    front = None if given["carry"] is None else 1 - given["carry"].alpha
    return {"stop": given["kind"].stop, "front": front, "backend": backend}


def _weights(given: Given, backend: str) -> tuple[Tensor]:
    return (weights(given["sigma"], _bundle(given).intervals, **_lit(given, backend)),)


def _visible(given: Given, backend: str) -> tuple[Tensor, ...]:
    return visible(given["sigma"], _bundle(given).intervals, **_lit(given, backend))


def _roundings(given: Given) -> float:
    """Those of a transmittance in both backends: 2 (n + 8) u."""
    return 2 * (given["kind"].most + 8) * U32


def _of_weights(given: Given) -> Tensor:
    return _roundings(given) * (given["sigma"] * given["delta"]).clamp(max=1)


def _of_sigma(given: Given) -> Tensor:
    channels = given["kind"].channels
    gain = channels + DEPTH + 1
    return given["delta"] * gain * (2 * _roundings(given) + 2 * (channels + 2) * U32)


SUM = f"{LIGHT}, and so are the weights together; adding them up, n u more: 4 (n + 8) u"
OF_A_WEIGHT = f"{LIGHT}; a weight is at most tau_i T: 2 (n + 8) min(tau_i, 1) u"

COMPOSITE = Operation(
    "composite",
    served(__package__),
    _composite,
    {
        "values": Bound(SUM, lambda given: 2 * _roundings(given)),
        "depth_sum": Bound("by t of at most 2, twice that", lambda given: 4 * _roundings(given)),
        "alpha": Bound("that of the values", lambda given: 2 * _roundings(given)),
    },
    {
        "sigma": Bound(
            "length times a difference of weighted gains; a gain is a sum of K + 2 products of at "
            "most K + 3: delta (K + 3) (4 (n + 8) + 2 (K + 2)) u",
            _of_sigma,
        ),
        "values": Bound(OF_A_WEIGHT, lambda given: _of_weights(given)[:, None]),
    },
)
WEIGHTS = Operation(
    "composite weights", served(__package__), _weights, {"weights": Bound(OF_A_WEIGHT, _of_weights)}
)
VISIBLE = Operation(
    "composite visible",
    served(__package__),
    _visible,
    {
        "counts": Bound("no transmittance is within rounding of the stop: 0", 0.0),
        "left": Bound(f"{LIGHT}: 2 (n + 8) u", _roundings),
    },
)


def _samples(extreme: tuple[float, float]) -> Bundle:
    """One ray of 8 samples, the fourth `extreme`, in float64."""
    sigma, delta = torch.full((8,), 2.0), torch.full((8,), 0.1)
    sigma, delta = sigma.double(), delta.double()
    sigma[3], delta[3] = extreme
    values = torch.linspace(0, 1, 24).view(8, 3).flip(0).double()
    t = torch.linspace(0, 2, 8).double()
    return Bundle(sigma, values, t, delta, torch.tensor([8]))


def _exact_weights(sigma: Tensor, delta: Tensor) -> tuple[Tensor, Tensor]:
    """Weights of one ray and transmittance before and after its samples, closed form, float64."""
    tau = torch.where(delta > 0, sigma * delta, 0)
    behind = torch.exp(-tau.cumsum(0))
    front = torch.cat((behind.new_ones(1), behind[:-1]))
    return front * -torch.expm1(-tau), behind


def _pixel_error(extreme: tuple[float, float], backend: str, device: str, precision: str) -> float:
    samples = _samples(extreme).apply(lambda x: x.to(DTYPES[precision]))
    pixels = samples.to(device).composite(backend)
    exact = samples.apply(Tensor.double)
    weights, _ = _exact_weights(exact.sigma, exact.delta)
    want = (weights @ exact.values)[None], (weights @ exact.t)[None], weights.sum()[None]
    return largest_error(_cpu(pixels), want)


def _gradient_error(
    extreme: tuple[float, float], backend: str, device: str, precision: str
) -> float:
    """Error of the gradient of the sum of all outputs by sigma, over the sample's length."""
    samples = _samples(extreme).apply(lambda x: x.to(DTYPES[precision])).to(device)
    sigma, values = samples.sigma.requires_grad_(), samples.values.requires_grad_()
    pixels = samples.composite(backend)
    total = pixels.values.sum() + pixels.depth_sum.sum() + pixels.alpha.sum()
    got_sigma, got_values = torch.autograd.grad(total, (sigma, values))

    exact = samples.apply(lambda x: x.detach().cpu().double())
    delta = exact.delta
    weights, behind = _exact_weights(exact.sigma, delta)
    gain = exact.values.sum(dim=1) + exact.t + 1
    later = (weights * gain).flip(0).cumsum(0).flip(0) - weights * gain
    length = torch.where(delta > 0, delta, 1)
    want_sigma = torch.where(delta > 0, behind * gain - later, 0)
    want_values = weights[:, None].expand(8, 3)
    return largest_error(
        (got_sigma.cpu().double() / length, got_values.cpu()), (want_sigma, want_values)
    )


def _light_error(count: int, kind: str, backend: str, device: str, precision: str) -> float:
    """|sum of weights + exact transmittance of the ray - 1|."""
    tau = {"thin": [1e-4], "opaque": [50.0], "alternating": [1e-4, 0.0, 1e-2, 1e-30]}[kind]
    delta = torch.tensor(tau, dtype=DTYPES[precision]).repeat(-(-count // len(tau)))[:count]
    ones = torch.ones(count, dtype=delta.dtype, device=device)
    samples = Bundle(ones, ones[:, None], ones, delta.to(device), torch.tensor([count]).to(device))
    pixels = samples.composite(backend)
    left = math.exp(-math.fsum(delta.double().tolist()))
    sums = (pixels.values[0, 0], pixels.depth_sum[0], pixels.alpha[0])
    return max(abs(x.double().item() + left - 1) for x in sums)


def random_rays(seed: int, rays: int, most: int) -> Bundle:
    """`rays` rays with up to `most` samples each, from empty to opaque."""
    generator = torch.Generator().manual_seed(seed)
    counts = torch.randint(0, most + 1, (rays,), generator=generator)
    total = int(counts.sum())
    return Bundle(
        10 ** (6 * torch.rand(total, generator=generator) - 3),
        torch.rand(total, 3, generator=generator),
        2 * torch.rand(total, generator=generator),
        torch.rand(total, generator=generator) / 8,
        counts,
    )


def change_error(changed: Change, samples: Bundle, backend: str, device: str) -> float:
    """Largest difference between the pixels of `samples` before and after `changed`."""
    return largest_error(*(_cpu(x) for x in changed(samples.to(device), backend)))


def _change_error(changed: Change, backend: str, device: str, precision: str) -> float:
    return change_error(changed, random_rays(0, 50, 64), backend, device)


def split_interval(samples: Bundle, backend: str) -> tuple[Pixels, Pixels]:
    """Composite the front half of each ray first, then the rest behind it as `carry`."""
    half = samples.counts // 2
    first = _rank(samples) < half.repeat_interleave(samples.counts)
    front = replace(samples.apply(lambda x: x[first]), counts=half)
    behind = replace(samples.apply(lambda x: x[~first]), counts=samples.counts - half)
    return samples.composite(backend), behind.composite(backend, front.composite(backend))


def split_batch(samples: Bundle, backend: str) -> tuple[Pixels, Pixels]:
    """Composite the rays in reverse order, every third one in a batch of its own."""
    whole, order = samples.composite(backend), torch.arange(len(samples.counts)).flip(0)
    apart = whole.take(order)
    for part in (order[order % 3 == 0], order[order % 3 != 0]):
        if len(part):
            apart.put(part, samples.rays(part).composite(backend))
    return whole, apart


def separate_channels(samples: Bundle, backend: str) -> tuple[Pixels, Pixels]:
    """Composite one channel after the other."""
    apart = [replace(samples, values=samples.values[:, [i]]).composite(backend) for i in range(3)]
    values = torch.cat([part.values for part in apart], dim=1)
    return samples.composite(backend), Pixels(values, apart[0].depth_sum, apart[0].alpha)


def add_empty_sample(samples: Bundle, backend: str) -> tuple[Pixels, Pixels]:
    """Put a sample without density in front of every ray."""
    counts = samples.counts
    first = samples.intervals.offsets[:-1] + torch.arange(len(counts), device=counts.device)
    kept = first.repeat_interleave(counts) + 1 + _rank(samples)

    def widened(x: Tensor, value: float) -> Tensor:
        wide = x.new_full((len(x) + len(counts), *x.shape[1:]), value)
        wide[kept] = x
        return wide

    more = replace(
        samples.apply(lambda x: widened(x, 1.0)),
        sigma=widened(samples.sigma, 0.0),
        counts=counts + 1,
    )
    return samples.composite(backend), more.composite(backend)


def _rank(samples: Bundle) -> Tensor:
    """The index [S] of each sample on its ray."""
    counts = samples.counts
    return torch.cat([torch.arange(n, device=counts.device) for n in counts.tolist()])


SAME_SUM = on_backends(2 * (8 + math.log2(64))) | {("cpu", "fp32"): 0.0}
CHANGES = (
    (
        "interval split",
        split_interval,
        "[a, b] then [b, c] is [a, c]",
        "two pixels of up to 2, and 1 - alpha between them: 64 u",
        on_backends(64),
    ),
    ("batch split", split_batch, "each ray stays what it is", SAME, SAME_SUM),
    ("channels apart", separate_channels, "each channel stays what it is", SAME, SAME_SUM),
    ("empty sample added", add_empty_sample, "nothing changes", SAME, SAME_SUM),
)
"""Changes that may be made to rays, and what must hold for each."""


def _cpu(pixels: Pixels) -> tuple[Tensor, ...]:
    return tuple(x.detach().cpu() for x in (pixels.values, pixels.depth_sum, pixels.alpha))

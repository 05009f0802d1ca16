"""Cases of the compositing: agreement of the backends, extremes, long rays, invariances."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor
from torch.nn.functional import pad

from bench.case import DTYPES, U32, Agreement, Case, Property, largest_error, on_backends
from methods.kernels.composite import composite, visible, weights
from methods.kernels.dispatch import served
from methods.kernels.types import Intervals, Pixels

INF = math.inf

DEPTH = 2.0
"""Largest t of the samples, which bounds the summands, since values are at most 1."""


@dataclass(frozen=True)
class Kind:
    """Inputs of an agreement: `rays` of up to `most` samples."""

    rays: int
    most: int
    channels: int = 3
    density: float = 2.0
    background: bool = False
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
    "a background a ray": Kind(33, 20, background=True),
    # A ray could end a sample earlier only if its transmittance is within rounding of `stop`.
    "stopped after many samples": Kind(20, 200, stop=0.3),
}

TIMED = Kind(1 << 12, 64)

WEIGHTS = (
    "transmittance, a product of n rounded exponentials or the exponential of a rounded sum, is "
    "off by n u in each backend, and so are the weights, which add up to 1; adding them up: n u "
    "more; t up to 2: 8 (n + 8) u"
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


@dataclass(frozen=True)
class Inputs:
    """Inputs of an agreement: samples, the pixels in front, the background, a gradient."""

    samples: Bundle
    carry: Pixels | None
    background: Tensor
    grad: Tensor


Outputs = Callable[[Inputs, float, str], tuple[Tensor, ...]]
"""Computes results from inputs, stop and backend."""


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
    for subject, (outputs, derivation, factor) in OUTPUTS.items():
        kernel = Agreement(subject, served(__package__), derivation)
        for name, kind in KINDS.items():
            # 4 (n + 8) roundings, each relative to the size of t.
            tolerance = factor(kind) * 4 * (kind.most + 8) * U32 * DEPTH
            found.append(kernel.case(name, partial(_prepare, outputs, kind), tolerance))
        if outputs in (_pixels, _gradients):
            tolerance = factor(TIMED) * 4 * (TIMED.most + 8) * U32 * DEPTH
            prepare = partial(_prepare, outputs, TIMED)
            found.append(kernel.case("64 samples a ray", prepare, tolerance, items=1 << 18))
    return found


def _prepare(outputs: Outputs, kind: Kind, device: str) -> Callable[[str], tuple[Tensor, ...]]:
    generator = torch.Generator().manual_seed(kind.rays + kind.most)
    rays, channels = kind.rays, kind.channels
    draw = partial(torch.rand, generator=generator)
    counts = torch.randint(0, kind.most + 1, (rays,), generator=generator)
    if kind == Kind(rays, kind.most):
        counts[: rays // 2] = kind.most  # make sure that longest rays occur
    total = int(counts.sum())
    samples = Bundle(
        (kind.density * draw(total)).to(device).requires_grad_(),
        draw(total, channels).to(device).requires_grad_(),
        (DEPTH * draw(total)).to(device),
        (2.0 / max(kind.most, 1) * draw(total)).to(device),
        counts.to(device),
    )
    background = draw(rays, channels).to(device) if kind.background else torch.zeros(1)
    alpha = draw(rays).to(device)
    in_front = Pixels(alpha[:, None].expand(rays, channels), DEPTH * alpha, alpha)
    grad = draw(rays, channels + 2).to(device)
    inputs = Inputs(samples, in_front if kind.carry else None, background.to(device), grad)
    return partial(outputs, inputs, kind.stop)


def _pixels(inputs: Inputs, stop: float, backend: str) -> tuple[Tensor, ...]:
    pixels = inputs.samples.composite(backend, inputs.carry, stop).over(inputs.background)
    return pixels.values, pixels.depth_sum, pixels.alpha


def _gradients(inputs: Inputs, stop: float, backend: str) -> tuple[Tensor, ...]:
    values, depth_sum, alpha = _pixels(inputs, stop, backend)
    outputs = torch.cat((values, depth_sum[:, None], alpha[:, None]), dim=1)
    return torch.autograd.grad(outputs, [inputs.samples.sigma, inputs.samples.values], inputs.grad)


def _found_weights(inputs: Inputs, stop: float, backend: str) -> tuple[Tensor, ...]:
    samples, front = inputs.samples, None if inputs.carry is None else 1 - inputs.carry.alpha
    return (weights(samples.sigma, samples.intervals, stop=stop, front=front, backend=backend),)


def _visible(inputs: Inputs, stop: float, backend: str) -> tuple[Tensor, ...]:
    samples = inputs.samples
    front = None if inputs.carry is None else 1 - inputs.carry.alpha
    return visible(samples.sigma, samples.intervals, stop=0.3, front=front, backend=backend)


OUTPUTS: dict[str, tuple[Outputs, str, Callable[[Kind], int]]] = {
    "composite": (_pixels, WEIGHTS, lambda kind: 1),
    "composite backward": (
        _gradients,
        WEIGHTS + "; a gain is a product with K + 2 gradients of at most 1: K + 2 times that",
        lambda kind: kind.channels + 2,
    ),
    "composite weights": (_found_weights, WEIGHTS, lambda kind: 1),
    "composite visible": (
        _visible,
        WEIGHTS + "; a count is off by one if a transmittance, one in 10^6, is so near to the stop",
        lambda kind: 1,
    ),
}
"""What is computed, the derivation of its tolerance, and the factor of the tolerance."""


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


def _joined(parts: Sequence[Pixels]) -> Pixels:
    columns = ("values", "depth_sum", "alpha")
    return Pixels(*(torch.cat([getattr(part, name) for part in parts]) for name in columns))


def split_interval(samples: Bundle, backend: str) -> tuple[Pixels, Pixels]:
    """Composite the front half of each ray first, then the rest behind it as `carry`."""
    half = samples.counts // 2
    first = _rank(samples) < half.repeat_interleave(samples.counts)
    front = replace(samples.apply(lambda x: x[first]), counts=half)
    behind = replace(samples.apply(lambda x: x[~first]), counts=samples.counts - half)
    return samples.composite(backend), behind.composite(backend, front.composite(backend))


def permute_rays(samples: Bundle, backend: str) -> tuple[Pixels, Pixels]:
    """Composite the rays in reverse order."""
    order = torch.arange(len(samples.counts)).flip(0)
    return samples.composite(backend).take(order), samples.rays(order).composite(backend)


def split_batch(samples: Bundle, backend: str) -> tuple[Pixels, Pixels]:
    """Composite every third ray in a batch of its own."""
    order = torch.arange(len(samples.counts))
    parts = [order[order % 3 == 0], order[order % 3 != 0]]
    apart = _joined([samples.rays(part).composite(backend) for part in parts if len(part)])
    return samples.composite(backend).take(torch.cat(parts)), apart


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


def add_backgrounds(samples: Bundle, backend: str) -> tuple[Pixels, Pixels]:
    """Composite onto the sum of two backgrounds; compare with the sum of the separate results."""
    one, other = samples.values.new_tensor(((0.2, 0.5, 1.0), (0.7, 0.1, 0.4)))
    none = samples.composite(backend)
    first, second = (none.over(background) for background in (one, other))
    values = first.values + second.values - none.values
    return none.over(one + other), Pixels(values, none.depth_sum, none.alpha)


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
    ("rays permuted", permute_rays, "each ray stays what it is", SAME, SAME_SUM),
    ("batch split", split_batch, "each ray stays what it is", SAME, SAME_SUM),
    ("channels apart", separate_channels, "each channel stays what it is", SAME, SAME_SUM),
    ("empty sample added", add_empty_sample, "nothing changes", SAME, SAME_SUM),
    (
        "sum of backgrounds",
        add_backgrounds,
        "pixels are linear in the background",
        "three products and sums of up to 4: 16 u",
        on_backends(16),
    ),
)
"""Changes that may be made to rays, and what must hold for each."""


def _cpu(pixels: Pixels) -> tuple[Tensor, ...]:
    return tuple(x.detach().cpu() for x in (pixels.values, pixels.depth_sum, pixels.alpha))

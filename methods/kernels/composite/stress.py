"""The compositing at the extremes of density and length, and over very long rays."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial

import torch
from torch import Tensor

from bench.stress import StressCase
from methods.kernels.case import DTYPES, largest_error, on_backends
from methods.kernels.composite import Pixels, composite

INF = math.inf

Change = Callable[[dict[str, Tensor], str], tuple[Pixels, Pixels]]

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

PIXEL = "8 samples: a weight has 4 roundings, thickness in front and sum 9; values up to 2: 32 u"
RAY = (
    "a weight has 4 roundings, what is in front 1, a sum of n in pairs log2 n: (8 + log2 n) u; in "
    "fp64, where nothing wider is there to sum thicknesses in, n u more"
)
SAME = "a sum in another order: twice (8 + log2 n) u; the compiled one has no order to choose: 0"


def cases() -> list[StressCase]:
    """One extreme sample among ordinary ones; light kept over long rays; what changes nothing."""
    pixels = [
        StressCase(
            "composite",
            name,
            "pixels are those of the closed form",
            PIXEL,
            on_backends(32, "fp64", "fp16", "bf16"),
            partial(_pixel_error, extreme),
        )
        for name, extreme in EXTREMES.items()
    ]
    gradients = [
        StressCase(
            "composite backward",
            name,
            "gradients are finite and those of the closed form",
            "as of a pixel, by the length of the sample; behind it, as many again: 64 u",
            on_backends(64, "fp64"),
            partial(_gradient_error, extreme),
        )
        for name, extreme in EXTREMES.items()
    ]
    light = [
        StressCase(
            "transmittance",
            f"{count:,} samples, {kind}",
            "weights and what is left add up to 1",
            RAY,
            on_backends(8 + math.log2(count))
            | {("reference", "fp64"): (8 + math.log2(count) + count) * 2**-53},
            partial(_light_error, count, kind),
        )
        for count in LENGTHS
        for kind in ("thin", "opaque", "alternating")
    ]
    changes = [
        StressCase("composite", name, holds, derivation, cells, partial(_change_error, changed))
        for name, changed, holds, derivation, cells in CHANGES
    ]
    return [*pixels, *gradients, *light, *changes]


def _samples(extreme: tuple[float, float]) -> dict[str, Tensor]:
    """One ray of 8 samples, the fourth `extreme`, in float64."""
    sigma, delta = torch.full((8,), 2.0), torch.full((8,), 0.1)
    sigma, delta = sigma.double(), delta.double()
    sigma[3], delta[3] = extreme
    values = torch.linspace(0, 1, 24).view(8, 3).flip(0).double()
    return {"sigma": sigma, "values": values, "t": torch.linspace(0, 2, 8).double(), "delta": delta}


def _weights(sigma: Tensor, delta: Tensor) -> tuple[Tensor, Tensor]:
    """Closed form, in float64: weights of one ray, transmittance in front of and behind samples."""
    tau = torch.where(delta > 0, sigma * delta, 0)
    behind = torch.exp(-tau.cumsum(0))
    front = torch.cat((behind.new_ones(1), behind[:-1]))
    return front * -torch.expm1(-tau), behind


def _pixel_error(extreme: tuple[float, float], backend: str, device: str, precision: str) -> float:
    samples = {k: x.to(DTYPES[precision]) for k, x in _samples(extreme).items()}
    pixels = _composite({k: x.to(device) for k, x in samples.items()}, backend)
    exact = {k: x.double() for k, x in samples.items()}
    weights, _ = _weights(exact["sigma"], exact["delta"])
    want = (weights @ exact["values"])[None], (weights @ exact["t"])[None], weights.sum()[None]
    return largest_error(_cpu(pixels), want)


def _gradient_error(
    extreme: tuple[float, float], backend: str, device: str, precision: str
) -> float:
    """Of the sum of all outputs, by sigma, over the length of the sample."""
    samples = {k: x.to(device, DTYPES[precision]) for k, x in _samples(extreme).items()}
    sigma, values = samples["sigma"].requires_grad_(), samples["values"].requires_grad_()
    pixels = _composite(samples, backend)
    total = pixels.values.sum() + pixels.depth_sum.sum() + pixels.alpha.sum()
    got_sigma, got_values = torch.autograd.grad(total, (sigma, values))

    exact = {k: x.detach().cpu().double() for k, x in samples.items()}
    delta = exact["delta"]
    weights, behind = _weights(exact["sigma"], delta)
    gain = exact["values"].sum(dim=1) + exact["t"] + 1
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
    samples = {"sigma": ones, "values": ones[:, None], "t": ones, "delta": delta.to(device)}
    pixels = _composite(samples, backend)
    left = math.exp(-math.fsum(delta.double().tolist()))
    sums = (pixels.values[0, 0], pixels.depth_sum[0], pixels.alpha[0])
    return max(abs(x.double().item() + left - 1) for x in sums)


def random_rays(seed: int, rays: int, most: int) -> dict[str, Tensor]:
    """Up to `most` samples on each of `rays` rays, between empty and opaque."""
    generator = torch.Generator().manual_seed(seed)
    counts = torch.randint(0, most + 1, (rays,), generator=generator)
    total = int(counts.sum())
    return {
        "sigma": 10 ** (6 * torch.rand(total, generator=generator) - 3),
        "values": torch.rand(total, 3, generator=generator),
        "t": 2 * torch.rand(total, generator=generator),
        "delta": torch.rand(total, generator=generator) / 8,
        "counts": counts,
    }


def change_error(changed: Change, samples: dict[str, Tensor], backend: str, device: str) -> float:
    """Largest difference between the pixels of `samples` before and after what `changed` does."""
    placed = {name: x.to(device) for name, x in samples.items()}
    return largest_error(*(_cpu(x) for x in changed(placed, backend)))


def _change_error(changed: Change, backend: str, device: str, precision: str) -> float:
    return change_error(changed, random_rays(0, 50, 64), backend, device)


def _composite(
    samples: dict[str, Tensor],
    backend: str,
    background: Tensor | None = None,
    carry: Pixels | None = None,
) -> Pixels:
    """To the last sample of each ray; without `counts` they are all of one."""
    sigma = samples["sigma"]
    counts = samples.get("counts", torch.tensor([len(sigma)], device=sigma.device))
    return composite(
        sigma,
        samples["values"],
        samples["t"],
        samples["delta"],
        torch.nn.functional.pad(counts.cumsum(0), (1, 0)),
        background=background,
        stop=0.0,
        carry=carry,
        backend=backend,
    )


def _of_rays(samples: dict[str, Tensor], order: Tensor) -> dict[str, Tensor]:
    """The rays at `order`, with their samples."""
    parts = {name: samples[name].split(samples["counts"].tolist()) for name in PER_SAMPLE}
    chosen = {name: torch.cat([x[i] for i in order.tolist()]) for name, x in parts.items()}
    return chosen | {"counts": samples["counts"][order]}


PER_SAMPLE = ("sigma", "values", "t", "delta")


def _joined(parts: Sequence[Pixels]) -> Pixels:
    columns = ("values", "depth_sum", "alpha")
    return Pixels(*(torch.cat([getattr(part, name) for part in parts]) for name in columns))


def split_interval(samples: dict[str, Tensor], backend: str) -> tuple[Pixels, Pixels]:
    """Half of the samples of each ray first, the other half behind them."""
    counts = samples["counts"]
    within = torch.cat([torch.arange(n, device=counts.device) for n in counts.tolist()])
    first = within < (counts // 2).repeat_interleave(counts)
    front = {name: samples[name][first] for name in PER_SAMPLE} | {"counts": counts // 2}
    behind = {name: samples[name][~first] for name in PER_SAMPLE}
    behind["counts"] = counts - counts // 2
    continued = _composite(behind, backend, carry=_composite(front, backend))
    return _composite(samples, backend), continued


def permute_rays(samples: dict[str, Tensor], backend: str) -> tuple[Pixels, Pixels]:
    """The rays in reverse order."""
    order = torch.arange(len(samples["counts"])).flip(0)
    return _composite(samples, backend).take(order), _composite(_of_rays(samples, order), backend)


def split_batch(samples: dict[str, Tensor], backend: str) -> tuple[Pixels, Pixels]:
    """Every third ray in a batch of its own."""
    order = torch.arange(len(samples["counts"]))
    parts = [order[order % 3 == 0], order[order % 3 != 0]]
    apart = _joined([_composite(_of_rays(samples, part), backend) for part in parts if len(part)])
    return _composite(samples, backend).take(torch.cat(parts)), apart


def separate_channels(samples: dict[str, Tensor], backend: str) -> tuple[Pixels, Pixels]:
    """One channel after the other."""
    whole = _composite(samples, backend)
    apart = [_composite(samples | {"values": samples["values"][:, [i]]}, backend) for i in range(3)]
    values = torch.cat([part.values for part in apart], dim=1)
    return whole, Pixels(values, apart[0].depth_sum, apart[0].alpha)


def add_empty_sample(samples: dict[str, Tensor], backend: str) -> tuple[Pixels, Pixels]:
    """A sample without density in front of every ray."""
    counts = samples["counts"]
    first = torch.nn.functional.pad(counts.cumsum(0), (1, 0))[:-1]
    more = dict(samples, counts=counts + 1)
    fill = {"sigma": 0.0, "values": 1.0, "t": 1.0, "delta": 1.0}
    old = torch.cat([torch.arange(n, device=counts.device) for n in counts.tolist()])
    place = (first + torch.arange(len(counts), device=counts.device)).repeat_interleave(counts)
    for name, value in fill.items():
        x = samples[name]
        more[name] = x.new_full((len(x) + len(counts), *x.shape[1:]), value)
        more[name][place + 1 + old] = x
    return _composite(samples, backend), _composite(more, backend)


def add_backgrounds(samples: dict[str, Tensor], backend: str) -> tuple[Pixels, Pixels]:
    """Behind the sum of two backgrounds, or of one and the other less none."""
    one, other = samples["values"].new_tensor(((0.2, 0.5, 1.0), (0.7, 0.1, 0.4)))
    none, sum_ = _composite(samples, backend), _composite(samples, backend, background=one + other)
    first, second = (_composite(samples, backend, background=b) for b in (one, other))
    return sum_, Pixels(first.values + second.values - none.values, none.depth_sum, none.alpha)


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
    ("channels apart", separate_channels, "a channel knows of no other", SAME, SAME_SUM),
    ("empty sample added", add_empty_sample, "nothing changes", SAME, SAME_SUM),
    (
        "sum of backgrounds",
        add_backgrounds,
        "pixels are linear in the background",
        "three products and sums of up to 4: 16 u",
        on_backends(16),
    ),
)
"""What may be done to rays, and what must hold then."""


def _cpu(pixels: Pixels) -> tuple[Tensor, ...]:
    return tuple(x.detach().cpu() for x in (pixels.values, pixels.depth_sum, pixels.alpha))

"""Cases of the compositing: agreement of the backends, extremes, long rays."""

import math
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from bench.case import (
    U32,
    Bound,
    Cases,
    Given,
    Operation,
    Property,
    Random,
    largest_error,
    on_backends,
    placed,
)
from methods.kernels.composite import Visibility, composite, visibility
from methods.kernels.dispatch import served
from methods.kernels.types import Intervals, Pixels, offsets_of

INF = math.inf

DEPTH = 2.0  # largest t of the samples; values and gradients of pixels are at most 1

KINDS: dict[str, dict[str, Any]] = {
    "no ray": {"rays": 0, "most": 0},
    "rays without samples": {"rays": 5, "most": 0},
    "one sample a ray": {"rays": 7, "most": 1},
    "1024 samples a ray": {"rays": 3, "most": 1024},
    "ragged rays": {"rays": 101, "most": 37},
    "nine channels": {"channels": 9},
    "no density": {"density": 0.0},
    "opaque at once": {"density": 1e30},
    # A ray could end a sample earlier only if its transmittance, one in 10^6, is within rounding
    # of `stop`.
    "stopped after a few samples": {"rays": 40, "most": 12, "stop": 0.3},
    "stopped after many samples": {"most": 200, "stop": 0.3},
    "continued and stopped": {"carry": True, "stop": 0.3},
}
"""Inputs of an agreement, see `_given`."""

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
LIGHT = (
    "a transmittance T = exp(-tau), tau a sum of n, or a product of n, is off by (n + 8) T tau u "
    "in each backend, T tau < 1. On a GPU exp(-tau) is a power of 2 by an instruction of 2 ulp, "
    "off by (4 + 2.34 tau) exp(-tau) u: 4 u more, 2 (n + 10) u"
)
SUM = f"{LIGHT}, and so are the weights together, of n opacities: 4 (n + 10) u + 4 n u"
OF_A_WEIGHT = f"{LIGHT}; a weight is at most tau_i T: times min(tau_i, 1); an opacity 4 u more"


def _visibility(
    values: Tensor, carry: Pixels | None, sigma: Tensor, intervals: Intervals, **how: Any
) -> Visibility:
    return visibility(sigma, intervals, front=None if carry is None else 1 - carry.alpha, **how)


def _roundings(given: Given) -> float:
    """Those of a transmittance in both backends: 2 (n + 10) u."""
    return 2 * (_longest(given) + 10) * U32


def _longest(given: Given) -> int:
    counts = given["intervals"].offsets.diff()
    return int(counts.max()) if len(counts) else 0


def _of_sums(given: Given) -> float:
    return 2 * _roundings(given) + 4 * _longest(given) * U32


def _of_weights(given: Given) -> Tensor:
    return _roundings(given) * (given["sigma"] * given["intervals"].delta).clamp(max=1) + 4 * U32


def _of_sigma(given: Given) -> Tensor:
    channels = given["values"].shape[1]
    gain = channels + DEPTH + 1
    return given["intervals"].delta * gain * (_of_sums(given) + 2 * (channels + 2) * U32)


COMPOSITE = Operation(
    "composite",
    served(__package__),
    composite,
    {
        "values": Bound(SUM, _of_sums),
        "depth_sum": Bound("by t of at most 2, twice that", lambda given: 2 * _of_sums(given)),
        "alpha": Bound("that of the values", _of_sums),
    },
    {
        "sigma": Bound(
            "length times a difference of weighted gains; a gain is a sum of K + 2 products of at "
            "most K + 3: delta (K + 3) (4 (n + 10) + 4 n + 2 (K + 2)) u",
            _of_sigma,
        ),
        "values": Bound(OF_A_WEIGHT, lambda given: _of_weights(given)[:, None]),
    },
)
WEIGHTS = Operation(
    "composite weights",
    served(__package__),
    _visibility,
    {
        "weights": Bound(OF_A_WEIGHT, _of_weights),
        "counts": Bound("no transmittance is within rounding of the stop: 0", 0.0),
        "left": Bound(LIGHT, _roundings),
    },
)


def cases() -> Cases:
    """Agreements; one extreme sample among ordinary ones; sums of weights on long rays."""
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
    many = partial(_given, rays=1 << 12, most=64)
    found = COMPOSITE.cases("64 samples a ray", many, items=1 << 18)
    for name, options in KINDS.items():
        make = partial(_given, **options)
        found += [*COMPOSITE.cases(name, make), *WEIGHTS.cases(name, make)]
    for name, extreme in EXTREMES.items():
        found.append(pixels.case(name, _extreme_error, extreme, False))
        found.append(gradients.case(name, _extreme_error, extreme, True))
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
            found.append(light.case(name, _light_error, count, kind))
    return found


def _given(
    rays: int = 33,
    most: int = 20,
    channels: int = 3,
    density: float = 2.0,
    carry: bool = False,
    stop: float = 0.0,
) -> Given:
    """`rays` of up to `most` samples, which every second one has."""
    random = Random(rays + most)
    counts = random.whole(0, most + 1, rays)
    counts[: rays // 2] = most
    total = int(counts.sum())
    alpha = random.share(rays)
    front = Pixels(alpha[:, None].expand(rays, channels), DEPTH * alpha, alpha)
    return {
        "sigma": density * random.share(total),
        "values": random.share(total, channels),
        "intervals": Intervals(
            t=DEPTH * random.share(total),
            delta=DEPTH / max(most, 1) * random.share(total),
            offsets=offsets_of(counts),
        ),
        "carry": front if carry else None,
        "stop": stop,
    }


def _ray(sigma: Tensor, delta: Tensor, values: Tensor, t: Tensor, precision: str) -> Given:
    """Samples of a single ray, rounded."""
    intervals = Intervals(t, delta, torch.tensor([0, len(sigma)]))
    samples = {"sigma": sigma, "values": values, "intervals": intervals, "stop": 0.0}
    return placed(samples, "cpu", precision)


def _extreme_error(
    extreme: tuple[float, float], backward: bool, backend: str, device: str, precision: str
) -> float:
    """Error of the pixel of 8 samples, the fourth `extreme`; `backward`, that of the gradients of
    the sum of its numbers, by sigma over the sample's length."""
    sigma, delta = torch.full((2, 8), 2.0, dtype=torch.float64)
    delta[:] = 0.1
    sigma[3], delta[3] = extreme
    values = torch.linspace(0, 1, 24).view(8, 3).flip(0)
    t = torch.linspace(0, 2, 8)
    given = _ray(sigma, delta, values, t, precision)
    there = placed(given, device)
    learned = [there[name].requires_grad_(backward) for name in ("sigma", "values")]
    pixels = composite(**there, backend=backend).columns

    sigma, values, intervals, _ = placed(given, "cpu", "fp64").values()
    t = intervals.t
    delta = intervals.delta
    tau = torch.where(delta > 0, sigma * delta, 0)
    behind = torch.exp(-tau.cumsum(0))
    weights = pad(behind[:-1], (1, 0), value=1.0) * -torch.expm1(-tau)
    if not backward:
        want = (weights @ values)[None], (weights @ t)[None], weights.sum()[None]
        return largest_error(pixels, want)
    total = torch.cat([x.flatten() for x in pixels]).sum()
    of_sigma, of_values = (x.cpu() for x in torch.autograd.grad(total, learned))
    gain = values.sum(dim=1) + t + 1
    later = (weights * gain).flip(0).cumsum(0).flip(0) - weights * gain
    length = torch.where(delta > 0, delta, 1)
    exact = torch.where(delta > 0, behind * gain - later, 0), weights[:, None].expand(8, 3)
    return largest_error((of_sigma.double() / length, of_values), exact)


def _light_error(count: int, kind: str, backend: str, device: str, precision: str) -> float:
    """|sum of weights + exact transmittance of the ray - 1|."""
    tau = {"thin": [1e-4], "opaque": [50.0], "alternating": [1e-4, 0.0, 1e-2, 1e-30]}[kind]
    delta, ones = torch.tensor(tau).repeat(-(-count // len(tau)))[:count], torch.ones(count)
    given = _ray(ones, delta, ones[:, None], ones, precision)
    left = math.exp(-math.fsum(given["intervals"].delta.double().tolist()))
    pixels = composite(**placed(given, device), backend=backend)
    sums = torch.cat([x.flatten() for x in pixels.columns])
    return (sums.double() + left - 1).abs().max().item()

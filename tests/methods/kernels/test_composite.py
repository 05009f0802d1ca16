"""The reference of the compositing against a plain loop, closed forms and finite differences."""

from __future__ import annotations

import math

import hypothesis
import pytest
import torch
from hypothesis import strategies as st
from scipy import integrate
from torch import Tensor

from bench.case import U32
from methods.kernels.composite import composite as composite_samples
from methods.kernels.composite import visible, weights
from methods.kernels.composite.experiments import exact, slope
from methods.kernels.types import Intervals, Pixels

BACKENDS = ["reference", "cpu"]


def composite(
    sigma: Tensor, values: Tensor, t: Tensor, delta: Tensor, offsets: Tensor, **options
) -> Pixels:
    return composite_samples(sigma, values, Intervals(t, delta, offsets), **options)


def intervals(inputs: dict) -> Intervals:
    return Intervals(inputs["t"], inputs["delta"], inputs["offsets"])


def samples(
    counts: list[int], channels: int = 3, dtype: torch.dtype = torch.float32, seed: int = 0
) -> dict:
    generator = torch.Generator().manual_seed(len(counts) + seed)
    total = sum(counts)

    def draw(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=dtype)

    return {
        "sigma": 30 * draw(total),
        "values": draw(total, channels),
        "t": draw(total).cumsum(0),
        "delta": 0.1 * draw(total),
        "offsets": torch.tensor([0, *counts]).cumsum(0),
    }


def plain_composite(inputs: dict, stop: float) -> list[tuple[list[float], float, float]]:
    """The definition (Eq. 2, 3), a ray and a sample at a time, in Python numbers."""
    rays = []
    for begin, end in zip(inputs["offsets"][:-1], inputs["offsets"][1:], strict=True):
        colour, depth, alpha = [0.0] * inputs["values"].shape[1], 0.0, 0.0
        transmittance = 1.0
        for i in range(int(begin), int(end)):
            if transmittance <= stop:
                break
            opacity = 1 - math.exp(-inputs["sigma"][i].item() * inputs["delta"][i].item())
            weight = transmittance * opacity
            colour = [
                c + weight * v for c, v in zip(colour, inputs["values"][i].tolist(), strict=True)
            ]
            depth += weight * inputs["t"][i].item()
            alpha += weight
            transmittance *= 1 - opacity
        rays.append((colour, depth, alpha))
    return rays


@pytest.mark.parametrize("stop", [0.0, 0.3])
def test_reference_is_the_definition(stop: float) -> None:
    inputs = samples([4, 0, 1, 9], dtype=torch.float64)
    pixels = composite(**inputs, stop=stop, backend="reference")
    want = plain_composite(inputs, stop)
    for ray, (colour, depth, alpha) in enumerate(want):
        assert pixels.values[ray].tolist() == pytest.approx(colour, abs=1e-12)
        assert pixels.depth_sum[ray].item() == pytest.approx(depth, abs=1e-12)
        assert pixels.alpha[ray].item() == pytest.approx(alpha, abs=1e-12)


def part(inputs: dict, index: Tensor, counts: list[int]) -> dict:
    """Only the samples at `index`, on rays of `counts`."""
    columns = {name: inputs[name][index] for name in ("sigma", "values", "t", "delta")}
    return columns | {"offsets": torch.tensor([0, *counts]).cumsum(0)}


CHANNELS_APART, RAYS_APART, SPLIT = "channels apart", "rays apart", "behind a front half"


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("how", [CHANNELS_APART, RAYS_APART, SPLIT])
@hypothesis.given(
    counts=st.lists(st.integers(1, 64), min_size=1, max_size=12), seed=st.integers(0, 2**31)
)
def test_pixels_composited_in_parts_are_those_of_one_go(
    how: str, backend: str, counts: list[int], seed: int
) -> None:
    inputs = samples(counts, seed=seed)
    ray = torch.arange(len(counts)).repeat_interleave(torch.tensor(counts))
    whole = composite(**inputs, stop=0.0, backend=backend)
    if how == CHANNELS_APART:
        values = [inputs["values"][:, [channel]] for channel in range(3)]
        parts = [composite(**inputs | {"values": x}, stop=0.0, backend=backend) for x in values]
        got = Pixels(torch.cat([x.values for x in parts], 1), parts[0].depth_sum, parts[0].alpha)
    elif how == RAYS_APART:
        got = whole.take(torch.arange(len(counts)).flip(0))
        for number, count in enumerate(counts):
            alone = part(inputs, ray == number, [count])
            here = torch.tensor([number])
            got.put(here, composite(**alone, stop=0.0, backend=backend))
    else:
        halves = [count // 2 for count in counts]
        front = torch.cat([torch.arange(n) < half for n, half in zip(counts, halves, strict=True)])
        rest = [count - half for count, half in zip(counts, halves, strict=True)]
        carry = composite(**part(inputs, front, halves), stop=0.0, backend=backend)
        behind = part(inputs, ~front, rest)
        got = composite(**behind, stop=0.0, carry=carry, backend=backend)
    # The compiled kernel adds up front to back, whatever lies beside; the reference in an order
    # that depends on the longest ray, and at a split both round: sums of up to 64 weights.
    exact = backend == "cpu" and how != SPLIT
    for name, most in (("values", 1), ("depth_sum", 64), ("alpha", 1)):
        error = (getattr(got, name) - getattr(whole, name)).abs().max().item()
        assert error <= (0 if exact else 64 * most * U32), name


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("stop", [1e-4, 1e-2, 0.3])
def test_the_early_stop_changes_a_pixel_by_less_than_its_threshold(
    backend: str, stop: float
) -> None:
    inputs = samples([40] * 50)
    exact = composite(**inputs, stop=0.0, backend=backend)
    stopped = composite(**inputs, stop=stop, backend=backend)
    difference = (exact.alpha - stopped.alpha).abs().max().item()
    assert 0 < difference <= stop + 1e-6


@pytest.mark.parametrize("backend", BACKENDS)
def test_visible_samples_are_those_with_a_weight_which_is_the_gradient_of_their_value(
    backend: str,
) -> None:
    """Behind pixels in front, which stay as they were."""
    inputs, alpha = samples([40, 0, 1, 25], channels=1), torch.tensor([0.0, 0.5, 0.9, 0.2])
    carry = Pixels(torch.zeros(4, 1), torch.zeros(4), alpha.clone())
    values, given = inputs["values"].requires_grad_(), (inputs["sigma"], intervals(inputs))
    pixels = composite(**inputs | {"values": values}, stop=0.05, carry=carry, backend=backend)
    assert torch.equal(carry.alpha, alpha)
    (gradient,) = torch.autograd.grad(pixels.values.sum(), values)
    found = weights(*given, stop=0.05, front=1 - alpha, backend=backend)
    torch.testing.assert_close(found, gradient[:, 0], rtol=1e-5, atol=1e-7)
    counts, left = visible(*given, stop=0.05, front=1 - alpha, backend=backend)
    torch.testing.assert_close(left, 1 - pixels.alpha, rtol=0, atol=1e-6)
    assert 0 < counts[0] < 40
    ends = zip(found.split([40, 0, 1, 25]), counts.tolist(), strict=True)
    assert all((part[:count] > 0).all() and not part[count:].any() for part, count in ends)


def test_wrong_arguments_are_named() -> None:
    inputs = samples([5])
    with pytest.raises(ValueError, match="values: expected shape"):
        composite(**inputs | {"values": torch.zeros(4, 3)})
    with pytest.raises(ValueError, match="offsets: expected to end at the 5 samples"):
        composite(**inputs | {"offsets": torch.tensor([0, 6])})
    with pytest.raises(ValueError, match="float32"):
        composite(**samples([5], dtype=torch.float64), backend="cpu")


@pytest.mark.parametrize(("quantity", "power"), [("alpha", 0), ("depth_sum", 1)])
@pytest.mark.parametrize("y", [0.0, 0.3, 1.0])
def test_the_experiments_know_the_rendering_integral(quantity: str, power: int, y: float) -> None:
    place = torch.tensor(y, dtype=torch.float64)
    s = slope(place).item()
    want, _ = integrate.quad(lambda x: x**power * s * x * math.exp(-s * x * x / 2), 0, 1)
    assert exact(quantity, place).item() == pytest.approx(want, rel=1e-9)

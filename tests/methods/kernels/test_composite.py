"""The reference of the compositing against a plain loop, closed forms and finite differences."""

import math
from dataclasses import replace

import hypothesis
import pytest
import torch
from hypothesis import strategies as st
from scipy import integrate
from torch import Tensor

from bench.case import U32
from methods.kernels.composite import composite, visibility
from methods.kernels.composite.experiments import exact, slope
from methods.kernels.types import Intervals, Pixels, offsets_of
from tests.common import assert_near, refusal, seeded

Inputs = tuple[Tensor, Tensor, Intervals]


def samples(
    counts: list[int], channels: int = 3, dtype: torch.dtype = torch.float32, seed: int = 0
) -> Inputs:
    generator = seeded(len(counts) + seed)
    total = sum(counts)

    def draw(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=dtype)

    sigma, values = 30 * draw(total), draw(total, channels)
    t, delta = draw(total).cumsum(0), 0.1 * draw(total)
    return sigma, values, Intervals(t, delta, offsets_of(torch.tensor(counts)))


def by_definition(sigma: Tensor, delta: Tensor, shown: Tensor, stop: float) -> Tensor:
    """The sums of a ray of the numbers that its samples show (Eq. 2, 3)."""
    opacity = 1 - torch.exp(-sigma * delta)
    behind = (1 - opacity).cumprod(dim=0)
    before = torch.cat((torch.ones(1), behind))[:-1]
    weights = before * opacity
    weights[before <= stop] = 0
    return weights @ shown


@pytest.mark.parametrize("stop", [0.0, 0.3])
def test_reference_is_the_definition(stop):
    sigma, values, where = inputs = samples([4, 0, 1, 9], dtype=torch.float64)
    pixels = composite(*inputs, stop=stop, backend="reference")
    shown = torch.column_stack((values, where.t, torch.ones_like(sigma)))
    rays = zip(*(x.split([4, 0, 1, 9]) for x in (sigma, where.delta, shown)), strict=True)
    wanted = torch.stack([by_definition(*ray, stop) for ray in rays])
    got = torch.column_stack((pixels.values, pixels.depth_sum, pixels.alpha))
    assert_near(got, wanted, atol=1e-12)


def part(inputs: Inputs, index: Tensor, counts: list[int]) -> Inputs:
    """Only the samples where `index` is true, on rays of `counts`."""
    sigma, values, where = inputs
    some = where.chosen(index.nonzero().squeeze(1), offsets_of(torch.tensor(counts)), None)
    return sigma[index], values[index], some


CHANNELS_APART, RAYS_APART, SPLIT = "channels apart", "rays apart", "behind a front half"


@pytest.mark.parametrize("how", [CHANNELS_APART, RAYS_APART, SPLIT])
@hypothesis.given(
    counts=st.lists(st.integers(1, 64), min_size=1, max_size=12), seed=st.integers(0, 2**31)
)
def test_pixels_composited_in_parts_are_those_of_one_go(how, backend, counts, seed):
    sigma, values, where = inputs = samples(counts, seed=seed)
    ray = torch.arange(len(counts)).repeat_interleave(torch.tensor(counts))
    whole = composite(*inputs, stop=0.0, backend=backend)
    if how == CHANNELS_APART:
        columns = values.split(1, dim=1)
        parts = [composite(sigma, x, where, stop=0.0, backend=backend) for x in columns]
        got = Pixels(torch.cat([x.values for x in parts], 1), parts[0].depth_sum, parts[0].alpha)
    elif how == RAYS_APART:
        got = whole.take(torch.arange(len(counts)).flip(0))
        for number, count in enumerate(counts):
            alone = part(inputs, ray == number, [count])
            got.put(torch.tensor([number]), composite(*alone, stop=0.0, backend=backend))
    else:
        halves = [count // 2 for count in counts]
        front = torch.cat([torch.arange(n) < half for n, half in zip(counts, halves, strict=True)])
        rest = [count - half for count, half in zip(counts, halves, strict=True)]
        carry = composite(*part(inputs, front, halves), stop=0.0, backend=backend)
        got = composite(*part(inputs, ~front, rest), stop=0.0, carry=carry, backend=backend)
    # The compiled kernel adds up front to back, whatever lies beside; the reference in an order
    # that depends on the longest ray, and at a split both round: sums of up to 64 weights.
    equal = backend == "cpu" and how != SPLIT
    for name, most in (("values", 1), ("depth_sum", 64), ("alpha", 1)):
        error = (getattr(got, name) - getattr(whole, name)).abs().max().item()
        assert error <= (0 if equal else 64 * most * U32), name


def test_visible_samples_are_those_with_a_weight_which_is_the_gradient_of_their_value(backend):
    """Behind pixels in front, which stay as they were."""
    sigma, values, where = samples([40, 0, 1, 25], channels=1)
    alpha = torch.tensor([0.0, 0.5, 0.9, 0.2])
    carry = Pixels(torch.zeros(4, 1), torch.zeros(4), alpha.clone())
    values.requires_grad_()
    pixels = composite(sigma, values, where, stop=0.05, carry=carry, backend=backend)
    assert torch.equal(carry.alpha, alpha)
    (gradient,) = torch.autograd.grad(pixels.values.sum(), values)
    found, counts, left = visibility(sigma, where, stop=0.05, front=1 - alpha, backend=backend)
    torch.testing.assert_close(found, gradient[:, 0], rtol=1e-5, atol=1e-7)
    assert_near(left, 1 - pixels.alpha, atol=1e-6)
    assert 0 < counts[0] < 40
    ends = zip(found.split([40, 0, 1, 25]), counts.tolist(), strict=True)
    assert all((part[:count] > 0).all() and not part[count:].any() for part, count in ends)


def test_wrong_arguments_are_named():
    sigma, values, where = samples([5])
    with refusal("values: expected shape", ValueError):
        composite(sigma, values[1:], where)
    with refusal("offsets: expected to end at the 5 samples", ValueError):
        composite(sigma, values, replace(where, offsets=torch.tensor([0, 6])))
    with refusal("float32", ValueError):
        composite(*samples([5], dtype=torch.float64), backend="cpu")


@pytest.mark.parametrize(("quantity", "power"), [("alpha", 0), ("depth_sum", 1)])
@pytest.mark.parametrize("y", [0.0, 0.3, 1.0])
def test_the_experiments_know_the_rendering_integral(quantity, power, y):
    place = torch.tensor(y, dtype=torch.float64)
    s = slope(place).item()
    want, _ = integrate.quad(lambda x: x**power * s * x * math.exp(-s * x * x / 2), 0, 1)
    assert exact(quantity, place).item() == pytest.approx(want, rel=1e-9)

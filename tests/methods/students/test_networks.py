"""What students that are networks share: encodings, layers, densities."""

import math

import pytest
import torch

from methods.kernels import multiplies_bf16
from methods.students.networks import Dense, density_of, positional
from tests.common import assert_near, seeded

U = 2.0**-24


@pytest.mark.parametrize("scale", [1.0, math.pi])
@pytest.mark.parametrize("identity", [True, False])
@pytest.mark.parametrize("frequencies", [1, 4, 10])
def test_positional_encoding_is_its_formula(frequencies, identity, scale):
    values = 2 * torch.rand(300, 3, generator=seeded(0)) - 1
    found = positional(values, frequencies, identity=identity, scale=scale)
    assert found.shape == (300, 3 * (2 * frequencies + identity))
    exact = values.double()
    waves = [f(scale * 2.0**k * exact) for k in range(frequencies) for f in (torch.sin, torch.cos)]
    wanted = torch.cat([exact, *waves] if identity else waves, dim=1)
    # An angle below 4 is a product of two rounded numbers: off by 8 u, its functions by u more.
    # To double it doubles their error and adds 3 roundings: less than 2^(F - 1) (8 + 1 + 2 * 3) u.
    tolerance = 2 ** (frequencies - 1) * 15 * U
    assert_near(found.double(), wanted, atol=tolerance)


def test_a_layer_multiplies_in_bfloat16_only_where_it_is_fast():
    inputs = torch.randn(50, 20, generator=seeded(0))
    exact, rounded = (Dense(20, 30, precision, seeded(1)) for precision in ("fp32", "bf16"))
    assert torch.equal(exact.weight, rounded.weight)
    wanted = inputs @ exact.weight.T + exact.bias
    # Sums of 20 products, each below 4 in all but a few cases, of two numbers rounded to 8 bits.
    assert_near(exact(inputs), wanted, atol=20 * 20 * 4 * U)
    got = rounded(inputs)
    assert got.dtype == (torch.bfloat16 if multiplies_bf16("cpu") else torch.float32)
    torch.testing.assert_close(got.float(), wanted, rtol=2**-7, atol=20 * 4 * 2.0**-8)


def test_a_density_of_zero_can_be_raised_but_not_lowered():
    raw = torch.tensor([-1.0, -1.0, 2.0, 2.0], requires_grad=True)
    density = density_of(raw)
    assert density.tolist() == [0, 0, 2, 2]
    density.backward(torch.tensor([-1.0, 1.0, -1.0, 1.0]))
    assert raw.grad.tolist() == [-1, 0, -1, 1]

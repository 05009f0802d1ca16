"""Small networks against torch.nn, one by one, and what must not depend on what."""

import math

import torch
from torch import nn

from bench.case import U32
from methods.kilonerf.kernels.grouped_mlp import SHAPES, Networks, colours, densities
from tests.common import assert_near


def networks(count: int) -> tuple[Networks, list[dict[str, nn.Linear]]]:
    """The same ones, for the kernel and as modules of torch."""
    torch.manual_seed(count)
    modules = [{name: nn.Linear(*shape) for name, shape in SHAPES.items()} for _ in range(count)]
    few = {
        name: (
            torch.stack([module[name].weight.detach().T for module in modules]),
            torch.stack([module[name].bias.detach() for module in modules]),
        )
        for name in SHAPES
    }
    return few, modules


def test_they_are_those_of_torch_one_by_one(backend):
    few, modules = networks(4)
    numbers = torch.tensor([2, -1, 0, 2, 3, 0, 2, -1, 2, 2, 2, 2, 2])
    positions, directions = 2 * torch.rand(13, 3) - 1, torch.rand(13, 27)
    raw, geometry = densities(positions, numbers, few, backend=backend)
    shown = colours(geometry, directions, few, backend=backend)
    assert torch.equal(geometry[:, 32].long(), numbers)
    for s, n in enumerate(numbers.tolist()):
        if n < 0:
            assert not any(part.any() for part in (raw[s], geometry[s, :32], shown[s]))
            continue
        layers, x = modules[n], positions[s]
        parts = [x, *(f(2**k * x) for k in range(10) for f in (torch.sin, torch.cos))]
        with torch.no_grad():
            trunk = layers["mid"](layers["in"](torch.cat(parts)).relu()).relu()
            joined = torch.cat((layers["feature"](trunk), directions[s]))
            colour = layers["colour"](layers["direction"](joined).relu()).sigmoid()
            # Errors of the encoding, 188 u, pass three layers whose gains are below 6 each.
            assert abs(raw[s] - layers["density"](trunk)) < 188 * 6**3 * U32
        assert_near(shown[s], colour, atol=188 * 6**3 * U32)


def test_the_hidden_channels_have_a_gradient_even_of_networks_that_stay():
    few, _ = networks(1)
    grads = []
    for backend in ("reference", "cpu"):
        geometry = torch.zeros(3, 33, requires_grad=True)
        colours(geometry, torch.ones(3, 27), few, backend=backend).sum().backward()
        grads.append(geometry.grad)
    torch.testing.assert_close(*grads)
    assert grads[0].any()


def test_nan_stays_with_its_sample(backend):
    few, _ = networks(1)
    positions = torch.zeros(12, 3)
    positions[5] = math.nan
    raw, _ = densities(positions, torch.zeros(12, dtype=torch.int32), few, backend=backend)
    assert raw.isnan().nonzero().flatten().tolist() == [5]

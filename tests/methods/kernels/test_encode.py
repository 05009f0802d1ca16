"""The hash-grid encoding: published levels, gradients, what is collected and refused."""

from dataclasses import replace
from functools import partial

import pytest
import torch
from torch import Tensor

from methods.kernels.encode import HashGrid, SampleGradients, encode
from tests.common import refusal, seeded

GRID = HashGrid(levels=4, features=2, log2_table=8, n_min=3, n_max=30)


def random_table(grid: HashGrid, dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.rand(grid.entries, grid.features, dtype=dtype, generator=seeded(0)) - 0.5


def test_levels_of_the_released_grid():
    """Resolutions and parameter counts of ngp_pl and of the Instant-NGP paper."""
    new = partial(HashGrid, levels=16, features=2, n_min=16)
    grid = new(log2_table=19, n_max=1024)
    assert grid.resolutions == (
        *(16, 22, 28, 37, 49, 64, 85, 112),
        *(148, 195, 256, 338, 446, 589, 777, 1024),
    )
    assert grid.strides == (*grid.resolutions[:6], *[0] * 10)
    assert grid.entries * grid.features == 11_420_064
    assert new(log2_table=16, n_max=2048).entries * 2 == 1_796_048
    assert new(log2_table=19, n_max=4096).entries * 2 == 12_599_920


def test_gradients_in_float64():
    table = random_table(GRID).requires_grad_()
    positions = torch.rand(5, 3, dtype=torch.float64, generator=seeded(2)).requires_grad_()
    assert torch.autograd.gradcheck(
        lambda x, t: encode(x, t, GRID, backend="reference"), (positions, table)
    )


@pytest.mark.parametrize("asked", [False, True])
def test_gradients_of_samples_are_collected_whether_or_not_the_table_asks_for_its_own(
    backend, asked
):
    table = random_table(GRID, torch.float32).requires_grad_(asked)
    positions = torch.rand(100, 3, generator=seeded(0))
    gradients = SampleGradients()
    for scale, part in zip((1, 2), positions.split(60), strict=True):
        features = encode(part, table, GRID, gradients=gradients, backend=backend)
        (scale * features).sum().backward()
    with torch.no_grad():
        encode(positions, table, GRID, gradients=gradients, backend=backend)
    found, gradient = gradients.joined()
    assert torch.equal(found, positions)
    assert torch.equal(gradient[:, 0], torch.tensor([1.0] * 60 + [2.0] * 40))
    assert table.grad is None


def test_a_position_that_is_not_a_number_spoils_its_own_features_alone(backend):
    table = random_table(GRID, torch.float32).requires_grad_()
    positions = torch.rand(70, 3, generator=seeded(0))
    positions[::7, 1] = torch.nan
    good = ~positions.isnan().any(dim=1)
    found, want = (encode(x, table, GRID, backend=backend) for x in (positions, positions[good]))
    assert torch.equal(found[good], want)
    assert found[~good].isnan().all()
    gradients = (torch.autograd.grad(x, table, torch.ones_like(x)) for x in (found, want))
    torch.testing.assert_close(*gradients)


def test_wrong_arguments_are_named():
    table = random_table(GRID, torch.float32)
    with refusal(r"positions: expected shape \[any, 3\], got \[4, 2\]", ValueError):
        encode(torch.zeros(4, 2), table, GRID)
    with refusal("table: expected shape", ValueError):
        encode(torch.zeros(4, 3), table[1:], GRID)
    with refusal("float32", ValueError):
        encode(torch.zeros(4, 3), table.double(), GRID, backend="cpu")
    with refusal("n_min <= n_max", ValueError):
        replace(GRID, n_min=64)
    with refusal("no gradient for positions", ValueError):
        encode(torch.zeros(4, 3, requires_grad=True), table, GRID, backend="cpu")

"""The hash-grid encoding against a plain loop, closed forms and finite differences."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from methods.kernels.encode import PRIMES, HashGrid, SampleGradients, encode, pack

GRID = HashGrid(levels=4, log2_table=8, n_min=3, n_max=30)


def plain_encode(position: list[float], table: Tensor, grid: HashGrid) -> list[float]:
    """The definition, one sample at a time, in Python numbers."""
    features: list[float] = []
    for level in range(grid.levels):
        growth = (grid.n_max / grid.n_min) ** (1 / (grid.levels - 1))
        scale = grid.n_min * growth**level - 1
        res = math.ceil(scale - 1e-6) + 1
        size = min((res**3 + 7) // 8 * 8, 2**grid.log2_table)
        total = [0.0] * grid.features
        scaled = [scale * x + 0.5 for x in position]
        for corner in range(8):
            vertex, weight = [], 1.0
            for axis in range(3):
                cell = math.floor(scaled[axis])
                high = corner >> axis & 1
                fraction = scaled[axis] - cell
                vertex.append(cell + high)
                weight *= fraction if high else 1 - fraction
            if res**3 <= size:
                entry = vertex[0] + vertex[1] * res + vertex[2] * res * res
            else:
                entry = 0
                for axis in range(3):
                    entry ^= (vertex[axis] * PRIMES[axis]) % 2**32
            row = table[grid.offsets[level] + entry % size]
            total = [t + weight * value.item() for t, value in zip(total, row, strict=True)]
        features += total
    return features


def random_table(grid: HashGrid, dtype: torch.dtype = torch.float64) -> Tensor:
    generator = torch.Generator().manual_seed(0)
    return torch.rand(grid.entries, grid.features, dtype=dtype, generator=generator) - 0.5


@pytest.mark.parametrize("features", [1, 2, 4])
def test_reference_is_the_definition(features: int) -> None:
    grid = HashGrid(levels=4, features=features, log2_table=8, n_min=3, n_max=30)
    table = random_table(grid)
    generator = torch.Generator().manual_seed(1)
    positions = torch.rand(20, 3, dtype=torch.float64, generator=generator)
    positions[0], positions[1] = 0.0, 1.0
    got = encode(positions, table, grid, backend="reference")
    want = torch.tensor([plain_encode(p, table, grid) for p in positions.tolist()])
    torch.testing.assert_close(got, want.double(), rtol=0, atol=1e-6)  # scale: growth to a power


def test_levels_of_the_released_grid() -> None:
    """Resolutions and parameter counts of ngp_pl and of the Instant-NGP paper."""
    grid = HashGrid(log2_table=19, n_min=16, n_max=1024)
    assert grid.resolutions == (
        *(16, 22, 28, 37, 49, 64, 85, 112),
        *(148, 195, 256, 338, 446, 589, 777, 1024),
    )
    assert grid.dense == (True,) * 6 + (False,) * 10
    assert grid.entries * grid.features == 11_420_064
    assert HashGrid(log2_table=16, n_max=2048).entries * 2 == 1_796_048
    assert HashGrid(log2_table=19, n_max=4096).entries * 2 == 12_599_920


def test_gradients_in_float64() -> None:
    table = random_table(GRID).requires_grad_()
    generator = torch.Generator().manual_seed(2)
    positions = torch.rand(5, 3, dtype=torch.float64, generator=generator).requires_grad_()
    assert torch.autograd.gradcheck(
        lambda x, t: encode(x, t, GRID, backend="reference"), (positions, table)
    )


@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_a_dense_level_interpolates_a_linear_function_exactly(backend: str) -> None:
    grid = HashGrid(levels=1, features=1, log2_table=15, n_min=20, n_max=20)
    x = torch.arange(20.0)
    vertices = x[:, None, None] * 100 + x[:, None] * 10 + x  # [z, y, x]
    table = torch.nn.functional.pad(vertices.flatten(), (0, grid.entries - 8000))[:, None]
    positions = torch.rand(50, 3, generator=torch.Generator().manual_seed(0)) * 0.9
    scaled = positions * 19 + 0.5
    want = scaled @ torch.tensor([1.0, 10.0, 100.0])
    got = encode(positions, table, grid, backend=backend)[:, 0]
    torch.testing.assert_close(got, want, rtol=1e-5, atol=0)


@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_the_packed_table_is_the_table_in_bfloat16(backend: str) -> None:
    table = random_table(GRID, torch.float32)
    rounded = table.bfloat16().float()
    positions = torch.rand(100, 3, generator=torch.Generator().manual_seed(0))
    want = encode(positions, rounded, GRID, backend=backend)
    got = encode(positions, table, GRID, packed=pack(table), backend=backend)
    assert got.dtype == torch.bfloat16
    # Half an ulp of bfloat16, at values of at most 1/2.
    torch.testing.assert_close(got.float(), want, rtol=0, atol=2.0**-10)


@pytest.mark.parametrize("backend", ["reference", "cpu"])
@pytest.mark.parametrize("asked", [False, True])
def test_gradients_of_samples_are_collected_whether_or_not_the_table_asks_for_its_own(
    backend: str, asked: bool
) -> None:
    table = random_table(GRID, torch.float32).requires_grad_(asked)
    positions = torch.rand(100, 3, generator=torch.Generator().manual_seed(0))
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


def test_the_backward_pass_gives_the_same_bits_twice() -> None:
    table = random_table(GRID, torch.float32).requires_grad_()
    positions = torch.rand(5000, 3, generator=torch.Generator().manual_seed(0))
    twice = [
        torch.autograd.grad(encode(positions, table, GRID, backend="cpu").square().sum(), table)[0]
        for _ in range(2)
    ]
    assert torch.equal(*twice)


def test_wrong_arguments_are_named() -> None:
    table = random_table(GRID, torch.float32)
    with pytest.raises(ValueError, match=r"positions: expected shape \[any, 3\], got \[4, 2\]"):
        encode(torch.zeros(4, 2), table, GRID)
    with pytest.raises(ValueError, match="table: expected shape"):
        encode(torch.zeros(4, 3), table[1:], GRID)
    with pytest.raises(ValueError, match="float32"):
        encode(torch.zeros(4, 3), table.double(), GRID, backend="cpu")
    with pytest.raises(ValueError, match="no gradient for positions"):
        encode(torch.zeros(4, 3, requires_grad=True), table, GRID, backend="cpu")
    with pytest.raises(ValueError, match="n_min <= n_max"):
        HashGrid(n_min=64, n_max=32)

"""The hash-grid encoding at the ends of the cube, on grid lines, in the largest tables."""

from __future__ import annotations

import itertools
import math
from functools import partial

import numpy as np
import torch
from torch import Tensor

from bench.stress import Cell, StressCase
from methods.kernels.case import DTYPES, U16, U32, largest_error, on_backends
from methods.kernels.encode import PRIMES, HashGrid, encode, pack

GRID = HashGrid(levels=8, log2_table=12, n_min=4, n_max=512)
LARGEST = HashGrid(levels=17, features=8, log2_table=24, n_min=512, n_max=4096)
"""More than 2^31 numbers, all levels hashed."""

BELOW_1 = 1 - 2.0**-24
"""The float32 before 1."""

UNITS = 12 * GRID.n_max + 11
DERIVATION = "a place is off by 2 u N_max along 3 axes, a blend of 8 corners has 11 roundings"


def cases() -> list[StressCase]:
    """Ends, grid lines, places that are none, and a table of 17 x 2^24 entries."""
    packed = {(backend, "bf16"): UNITS * U32 + U16 for backend in ("reference", "cpu")}
    kinds = {
        "at 0": _product(0.0),
        "at 1": _product(1.0),
        "at 1 less an ulp": _product(BELOW_1),
        "at 0, at 1 and next to them": _product(0.0, 2.0**-149, 1e-30, 0.5, BELOW_1, 1.0),
        "on grid lines": _grid_lines(),
        "beyond the cube": _product(-math.inf, -1e30, -0.0, 1.5, 1e30, math.inf),
    }
    found = [
        StressCase(
            "encode",
            name,
            "features are those of the closed form, of the nearest place in the cube",
            DERIVATION + (": 12 N_max + 11 u; bf16: half an ulp more"),
            on_backends(UNITS, "fp64") | packed,
            partial(_feature_error, positions),
        )
        for name, positions in kinds.items()
    ]
    exact: dict[Cell, float] = dict.fromkeys([*on_backends(0), *packed], 0.0)
    found.append(
        StressCase(
            "encode",
            "NaN",
            "is reported in its own features, and changes no others, nor any gradient",
            "the same arithmetic for all other places: 0",
            exact,
            _spread_of_nan,
        )
    )
    found.append(
        StressCase(
            "encode",
            "2^31 numbers in the table",
            "features are those of the closed form",
            DERIVATION + ": 12 N_max + 11 u",
            on_backends(12 * LARGEST.n_max + 11),
            _largest_table_error,
            slow=True,  # reserves, though it does not fill, 9 GB
        )
    )
    return found


def _product(*edges: float) -> Tensor:
    return torch.tensor(list(itertools.product(edges, repeat=3)), dtype=torch.float64)


def _grid_lines() -> Tensor:
    """Where scale x + 1/2 is whole along some axes, of every level."""
    lines = [(k + 0.5) / scale for scale in GRID.scales for k in (0, 1, int(scale) // 2)]
    return torch.tensor([(x, y, 0.3) for x in lines for y in lines], dtype=torch.float64)


def _value(entry: int, feature: int) -> float:
    """What stands in a table, a multiple of 1/64 from -1 to 1."""
    return (entry * 31 + feature * 17) % 129 / 64 - 1


def _corners(position: list[float], grid: HashGrid, level: int) -> list[tuple[int, float]]:
    """Entries around a place in the cube and their weights, in Python's own numbers."""
    places = [x * grid.scales[level] + 0.5 for x in position]
    found = []
    for bits in itertools.product((0, 1), repeat=3):
        x, y, z = (math.floor(p) + bit for p, bit in zip(places, bits, strict=True))
        weight = math.prod(
            p - math.floor(p) if bit else 1 - (p - math.floor(p))
            for p, bit in zip(places, bits, strict=True)
        )
        if grid.dense[level]:
            res = grid.resolutions[level]
            index = (x + y * res + z * res * res) % grid.sizes[level]
        else:
            index = x ^ y * PRIMES[1] % 2**32 ^ z * PRIMES[2] % 2**32
            index %= grid.sizes[level]
        found.append((grid.offsets[level] + index, weight))
    return found


def _exact(positions: Tensor, grid: HashGrid) -> Tensor:
    return torch.tensor(
        [
            [
                math.fsum(w * _value(e, f) for e, w in _corners(position, grid, level))
                for level in range(grid.levels)
                for f in range(grid.features)
            ]
            for position in positions.double().clamp(0, 1).tolist()
        ],
        dtype=torch.float64,
    )


def _table() -> Tensor:
    return torch.tensor([[_value(e, f) for f in (0, 1)] for e in range(GRID.entries)])


def _encoded(positions: Tensor, table: Tensor, precision: str, backend: str) -> Tensor:
    words = pack(table) if precision == "bf16" else None
    return encode(positions, table, GRID, packed=words, backend=backend)


def _feature_error(positions: Tensor, backend: str, device: str, precision: str) -> float:
    dtype = torch.float32 if precision == "bf16" else DTYPES[precision]
    places = positions.to(dtype)
    got = _encoded(places.to(device), _table().to(device, dtype), precision, backend)
    return largest_error((got.cpu(),), (_exact(places, GRID),))


def _spread_of_nan(backend: str, device: str, precision: str) -> float:
    """Difference that NaN in every 7th place makes to others, and to a gradient that it has no
    part in; infinite where it is not reported."""
    generator = torch.Generator().manual_seed(0)
    positions = torch.rand(700, 3, generator=generator).to(device)
    bad = torch.arange(700, device=device) % 7 == 0
    spoiled = positions.clone()
    spoiled[bad, 1] = torch.nan
    table = _table().to(device)
    features, grads = [], []
    for places in (spoiled, positions):
        learned = table.clone().requires_grad_()
        found = _encoded(places, learned, precision, backend)
        (grad,) = torch.autograd.grad(torch.where(bad[:, None], 0, found).sum(), learned)
        features.append(found.detach())
        grads.append(grad)
    if not features[0][bad].isnan().all():
        return math.inf
    return largest_error((features[0][~bad], grads[0]), (features[1][~bad], grads[1]))


def _largest_table_error(backend: str, device: str, precision: str) -> float:
    generator = torch.Generator().manual_seed(0)
    positions = torch.rand(16, 3, generator=generator)
    # Pages that nobody writes to take no memory.
    table = torch.from_numpy(np.zeros((LARGEST.entries, LARGEST.features), np.float32))
    for position in positions.tolist():
        for level in range(LARGEST.levels):
            for entry, _ in _corners(position, LARGEST, level):
                table[entry] = torch.tensor([_value(entry, f) for f in range(LARGEST.features)])
    got = encode(positions.to(device), table.to(device), LARGEST, backend=backend)
    return largest_error((got.cpu(),), (_exact(positions, LARGEST),))

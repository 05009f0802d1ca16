"""Cases of the hash-grid encoding: agreement of the backends, ends of the cube."""

import itertools
import math

import torch
from torch import Tensor

from bench.case import (
    U16,
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
from methods.kernels.dispatch import served
from methods.kernels.encode import PRIMES, HashGrid, encode, pack
from methods.kernels.encode.reference import corners

SMALL = HashGrid(levels=4, features=2, log2_table=10, n_min=4, n_max=40)
ODD = HashGrid(levels=3, features=3, log2_table=8, n_min=3, n_max=17)
LARGE = HashGrid(levels=16, features=2, log2_table=19, n_min=16, n_max=2048)
VIEW = 1 << 17  # samples of one view, for which the throughput is measured

GRID = HashGrid(levels=8, features=2, log2_table=12, n_min=4, n_max=512)

BELOW_1 = 1 - 2.0**-24  # the float32 before 1

FEATURES = (
    "at a level of N cells a position is off by 2 u N along each of 3 axes, where values of at "
    "most 1 differ by 2; a blend of 8 corners has 11 roundings: 12 N + 11 u; bf16: half an ulp more"
)
SUMS = (
    "an entry sums gradients of at most 1 over n samples by weights that add up to w; a weight is "
    "off by its 3 fractions, 6 N u, and a sum by w u; of 2 n independent roundings, 8 sqrt(n) add "
    "up, but for one entry in 10^13 (Higham, Mary 2019)"
)


def _of_features(given: Given) -> Tensor:
    """Tolerance of the features of each channel; see `FEATURES`."""
    grid = given["grid"]
    rounding = 0.0 if given["packed"] is None else U16
    of_level = [_units(scale) * U32 + rounding for scale in grid.scales]
    return torch.tensor(of_level).repeat_interleave(grid.features)


def _of_sums(given: Given) -> Tensor:
    """Tolerance of the gradient of each entry of the table, [entries, 1]; see `SUMS`."""
    grid, tolerance = given["grid"], []
    for level, (scale, size) in enumerate(zip(grid.scales, grid.sizes, strict=True)):
        entries, weights = corners(given["positions"].nan_to_num(), grid, level)
        entry = entries.flatten() - grid.offsets[level]
        count = torch.bincount(entry, minlength=size)
        total = torch.bincount(entry, weights.flatten(), minlength=size)
        tolerance.append(8 * count.sqrt() * (6 * scale + total) * U32)
    return torch.cat(tolerance)[:, None]


def _units(cells: float) -> float:
    """Tolerance of a feature in units of u; see `FEATURES`."""
    return 12 * cells + 11


ENCODE = Operation(
    "encode",
    served(__package__),
    encode,
    {"features": Bound(FEATURES, _of_features)},
    {"table": Bound(SUMS, _of_sums)},
)


def cases() -> Cases:
    """Awkward shapes; one view; positions at borders, on grid lines and outside."""
    found = []
    for name, grid, positions, packed in (
        ("no sample", SMALL, _random(0), False),
        ("one sample", SMALL, _random(1), False),
        ("257 samples", SMALL, _random(257), False),
        ("three features", ODD, _random(1000), False),
        ("corners and NaN", SMALL, _product(0.0, 0.5, 1.0, math.nan).float(), False),
        ("257 samples, packed", SMALL, _random(257), True),
        ("view", LARGE, _view(VIEW), False),
        ("random", LARGE, _random(VIEW), False),
        ("view, packed", LARGE, _view(VIEW), True),
        ("random, packed", LARGE, _random(VIEW), True),
    ):
        precision = "bf16" if packed else "fp32"
        given = (positions, grid, packed)
        found += ENCODE.cases(name, _given, *given, precision=precision, items=len(positions))
    return [*found, *_extremes()]


def _given(positions: Tensor, grid: HashGrid, packed: bool) -> Given:
    """A random table of values of magnitude at most 1."""
    table = Random(len(positions)).signed(grid.entries, grid.features)
    words = pack(table) if packed else None
    return {"positions": positions, "table": table, "grid": grid, "packed": words}


def _random(count: int) -> Tensor:
    return Random(count).share(count, 3)


def _view(count: int) -> Tensor:
    """Samples of 64 x 64 neighbouring rays, ray by ray, a step of sqrt(3) / 1024 apart."""
    side, steps = 64, count // 64**2
    pixel = torch.linspace(0.3, 0.5, side)
    v, u = torch.meshgrid(pixel, pixel, indexing="ij")
    t = 0.3 + 3**0.5 / 1024 * torch.arange(steps)
    direction = torch.stack((u - 0.4, v - 0.4, torch.ones_like(u)), dim=-1)
    origin = torch.stack((u, v, torch.zeros_like(u)), dim=-1)
    return (origin[..., None, :] + t[:, None] * direction[..., None, :]).reshape(-1, 3)


def _extremes() -> Cases:
    packed = {(backend, "bf16"): _units(GRID.n_max) * U32 + U16 for backend in ("reference", "cpu")}
    kinds = {
        "at 0, at 1 and next to them": _product(0.0, 2.0**-149, 1e-30, 0.5, BELOW_1, 1.0),
        "on grid lines": _grid_lines(),
        "beyond the cube": _product(-math.inf, -1e30, -0.0, 1.5, 1e30, math.inf),
    }
    closed_form = Property(
        "encode",
        "features are those of the closed form at the nearest position in the cube",
        FEATURES,
        on_backends(_units(GRID.n_max), "fp64") | packed,
    )
    return [closed_form.case(name, _feature_error, at) for name, at in kinds.items()]


def _product(*edges: float) -> Tensor:
    return torch.tensor(list(itertools.product(edges, repeat=3)), dtype=torch.float64)


def _grid_lines() -> Tensor:
    """Positions where scale x + 1/2 is an integer along some axes, for every level."""
    lines = [(k + 0.5) / scale for scale in GRID.scales for k in (0, 1, int(scale) // 2)]
    return torch.tensor([(x, y, 0.3) for x in lines for y in lines], dtype=torch.float64)


def _exact(position: list[float], level: int, table: Tensor) -> Tensor:
    """Features [F] of a level, with entries and weights computed with Python's own numbers."""
    places = [x * GRID.scales[level] + 0.5 for x in position]
    res, size = GRID.strides[level], GRID.sizes[level]
    entries, weights = [], []
    for bits in itertools.product((0, 1), repeat=3):
        x, y, z = (math.floor(p) + bit for p, bit in zip(places, bits, strict=True))
        dense = x + y * res + z * res * res
        hashed = x ^ y * PRIMES[1] % 2**32 ^ z * PRIMES[2] % 2**32
        entries.append(GRID.offsets[level] + (dense if res else hashed) % size)
        shares = (p % 1 if bit else 1 - p % 1 for p, bit in zip(places, bits, strict=True))
        weights.append(math.prod(shares))
    return torch.tensor(weights, dtype=torch.float64) @ table[entries].double()


def _feature_error(positions: Tensor, backend: str, device: str, precision: str) -> float:
    # Multiples of 1/64, which bfloat16 holds.
    table = Random(0).whole(-64, 65, GRID.entries, GRID.features) / 64
    packed = pack(table) if precision == "bf16" else None
    given = {
        "positions": positions,
        "table": table,
        "grid": GRID,
        "packed": packed,
    }
    kind = precision if packed is None else "fp32"
    there = placed(given, device, kind)
    got = encode(**there, backend=backend)
    nearest = there["positions"].cpu().double().clamp(0, 1)
    exact = [
        _exact(position, level, table)
        for position in nearest.tolist()
        for level in range(GRID.levels)
    ]
    want = torch.cat(exact).view(got.shape)
    return largest_error((got,), (want,))

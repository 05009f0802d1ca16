"""Test cases of the engines: constant inputs, values outside the calibration range, NaN."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from bench.case import Case, Cell
from bench.console import ConsoleLog
from methods.engines import Engine, Inputs
from methods.engines.openvino_engine import OpenVino
from methods.engines.tensorrt_engine import TensorRt
from methods.engines.torch_engine import TorchEngine
from methods.steernerf_lean.kernels.depthwise import neighbours_of
from methods.steernerf_lean.lean_renderer import PRETRAINED_LAYOUT, CellNetwork, LeanRenderer

ENGINES: tuple[type[Engine], ...] = (TorchEngine, OpenVino, TensorRt)
CELLS: list[Cell] = [
    (engine.name, precision) for engine in ENGINES for precision in engine.precisions
]
TOLERANCE = {"fp32": 1e-5, "bf16": 0.03, "fp16": 0.03, "int8": 0.1}
SHARE = (
    "of the root mean square: fp32 adds hundreds of products in another order; below, numbers are "
    "rounded by 2^-8, or 1/510 of the range seen, before each of some ten layers"
)
COUNTED = "numbers of which that is not true are counted: 0"

SIDE, BLOCKS = 16, 6
"""Cells along a side of the view; blocks of the network, each of which reaches one cell farther."""


def cases() -> list[Case]:
    """Constant inputs, values far outside the calibration range, a cell of NaN."""
    shares = {cell: TOLERANCE[cell[1]] for cell in CELLS}
    exact = dict.fromkeys(CELLS, 0.0)
    int8 = {cell: 0.0 for cell in CELLS if cell[1] == "int8"}
    # In int8, layers saturate: no view of the calibration has such large activations.
    rounded = {cell: share for cell, share in shares.items() if cell not in int8}
    same, finite = "the output is that of the network", "the output is finite"
    saturates = "int8 saturates: twice as large, they give the same output, number by number"
    spread = "its output is NaN, but in int8; cells out of its reach are unchanged"
    eight, nan = "inputs 8 times as large as in the calibration", "a cell of NaN"

    def case(name: str, holds: str, why: str, tolerances: Any, error: Any) -> Case:
        # Engines take seconds to build.
        return Case("engine", name, holds, why, tolerances, error, slow=True)

    return [
        case("all inputs 0", same, SHARE, shares, partial(_error, 0.0)),
        case("all inputs 1/2", same, SHARE, rounded, partial(_error, 0.5)),
        case("inputs up to 1e4", finite, COUNTED, exact, _not_finite),
        case(eight, saturates, COUNTED, int8, _not_saturated),
        case(nan, spread, SHARE, shares, _spread_of_nan),
    ]


def _network() -> CellNetwork:
    """The network with the weights that come with the package."""
    renderer = LeanRenderer(3, 1, 4, width=64, blocks=BLOCKS, init="pretrained")
    return renderer.network.requires_grad_(False)


def _inputs(rows: Tensor, device: str) -> Inputs:
    """The network's inputs: `rows` and the neighbours of each."""
    neighbours = neighbours_of(torch.ones(1, SIDE, SIDE, dtype=torch.bool))
    return rows.to(device), neighbours.to(device)


def _random_rows(seed: int) -> Tensor:
    """Rows of a random view of 16 x 16 cells."""
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(SIDE**2, PRETRAINED_LAYOUT.width, generator=generator) - 0.5


@cache
def _built(engine: str, device: str, precision: Any) -> Callable[..., Inputs]:
    """The network as an engine runs it, calibrated on random views. Raises `Unavailable` if the
    engine, or its precision, does not exist on `device`."""
    chosen = next(kind for kind in ENGINES if kind.name == engine)(precision)
    chosen.check(torch.device(device))
    network, views = _network().to(device), [_inputs(_random_rows(n), device) for n in range(4)]
    with tempfile.TemporaryDirectory() as folder:
        log = ConsoleLog(Path(folder), quiet=True)
        return chosen.build(network, lambda: views, lambda: Path(folder), log).run


@torch.no_grad()
def _outputs(cell: Sequence[str], rows: Tensor) -> list[Tensor]:
    """All outputs for `rows` of an engine, on a device, in a precision, as float64."""
    run = _built(*cell)
    return [x.cpu().double().clone() for x in run(*_inputs(rows, cell[1]))]


def _apart(got: list[Tensor], want: list[Tensor]) -> float:
    """Root mean square of the difference relative to that of `want`, of the worst output."""
    shares = [
        ((g - w).square().mean() / w.square().mean()).sqrt().item()
        for g, w in zip(got, want, strict=True)
    ]
    return math.inf if any(map(math.isnan, shares)) else max(shares)


def _error(value: float, *cell: str) -> float:
    rows = torch.full_like(_random_rows(0), value)
    with torch.no_grad():
        want = [x.double() for x in _network()(*_inputs(rows, "cpu"))]
    return _apart(_outputs(cell, rows), want)


def _not_finite(*cell: str) -> float:
    outputs = _outputs(cell, 2e4 * _random_rows(0))
    return float(sum(x.numel() - int(x.isfinite().sum()) for x in outputs))


def _not_saturated(*cell: str) -> float:
    """How many values of the output change when inputs out of range double."""
    rows = _random_rows(0).sign() * 4
    pairs = zip(*(_outputs(cell, factor * rows) for factor in (1, 2)), strict=True)
    return float(sum(int((once != twice).sum()) for once, twice in pairs))


def _spread_of_nan(*cell: str) -> float:
    rows, place = _random_rows(0), torch.arange(SIDE**2)
    want = _outputs(cell, rows)
    rows[0] = torch.nan
    got = _outputs(cell, rows)
    if cell[-1] != "int8" and not all(x[0].isnan().all() for x in got):
        return math.inf
    far = (place // SIDE > BLOCKS) | (place % SIDE > BLOCKS)
    return _apart([x[far] for x in got], [x[far] for x in want])

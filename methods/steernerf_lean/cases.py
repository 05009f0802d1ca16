"""Test cases of the engines: constant inputs, values outside the calibration range, NaN."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import torch
from torch import Tensor

from bench.case import Case, Cell, Property
from bench.console import ConsoleLog
from methods.engines import Engine, Inputs, Precision
from methods.engines.openvino_engine import OpenVino
from methods.engines.tensorrt_engine import TensorRt
from methods.engines.torch_engine import TorchEngine
from methods.steernerf_lean.kernels.depthwise import neighbours_of
from methods.steernerf_lean.lean_renderer import LeanRenderer

ENGINES: tuple[type[Engine], ...] = (TorchEngine, OpenVino, TensorRt)
CELLS: list[Cell] = [
    (engine.name, precision) for engine in ENGINES for precision in engine.precisions
]

TOLERANCE = {"fp32": 1e-5, "bf16": 0.03, "fp16": 0.03, "int8": 0.1}
SHARE = (
    "of the root mean square: fp32 adds hundreds of products in another order; below, numbers are "
    "rounded by 2^-8, or 1/510 of the range seen, before each of some ten layers"
)

SIDE, BLOCKS = 16, 6
"""Cells along a side of the view; blocks of the network, each of which reaches one cell farther."""


def cases() -> list[Case]:
    """Constant inputs, values far outside the calibration range, a cell of NaN."""
    shares = {cell: TOLERANCE[cell[1]] for cell in CELLS}
    rounded = {cell: share for cell, share in shares.items() if cell[1] != "int8"}
    counted = {cell: 0.0 for cell in CELLS if cell[1] == "int8"}
    same = "the output is that of the network"
    cases = [
        Property("engine", same, SHARE, shares).case("all inputs 0", partial(_error, 0.0)),
        # Not in int8: layers saturate, as no view of the calibration has such large activations.
        Property("engine", same, SHARE, rounded).case("all inputs 1/2", partial(_error, 0.5)),
        Property(
            "engine", "the output is finite", "it is, or is not: 0", dict.fromkeys(CELLS, 0.0)
        ).case("inputs up to 1e4", _not_finite),
        Property(
            "engine",
            "int8 saturates: twice as large, they give the same output, number by number",
            "numbers that differ are counted: 0",
            counted,
        ).case("inputs 8 times as large as in the calibration", _not_saturated),
        Property(
            "engine",
            "its output is NaN, but in int8; cells out of its reach are unchanged",
            SHARE,
            shares,
        ).case("a cell of NaN", _spread_of_nan),
    ]
    return [replace(case, slow=True) for case in cases]  # engines take seconds to build


@cache
def _renderer() -> LeanRenderer:
    """The lean renderer with the weights that come with the package."""
    return LeanRenderer(3, 1, 4).requires_grad_(False)


def _placed(rows: Tensor, device: str) -> Inputs:
    """The network's inputs: `rows` and the neighbours of each."""
    neighbours = neighbours_of(torch.ones(1, SIDE, SIDE, dtype=torch.bool))
    return rows.to(device), neighbours.to(device)


def _random_rows(seed: int) -> Tensor:
    """Rows of a random view of 16 x 16 cells."""
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(SIDE**2, _renderer().layout.width, generator=generator) - 0.5


@cache
def _built(engine: str, device: str, precision: Precision) -> Callable[..., Inputs]:
    """The network as an engine runs it, calibrated on random views.

    Raises:
        Unavailable: the engine, or its precision, does not exist on `device`.
    """
    chosen = next(kind for kind in ENGINES if kind.name == engine)(precision)
    chosen.check(torch.device(device))
    network = deepcopy(_renderer().network).to(device)
    views = [_placed(_random_rows(seed), device) for seed in range(4)]
    with tempfile.TemporaryDirectory() as folder:
        log = ConsoleLog(Path(folder), quiet=True)
        return chosen.build(network, lambda: views, lambda: Path(folder), log).run


def _outputs(engine: str, device: str, precision: str, rows: Tensor) -> list[Tensor]:
    """All outputs of the engine for `rows`, in float64."""
    run = _built(engine, device, precision)
    with torch.no_grad():
        return [x.cpu().double().clone() for x in run(*_placed(rows, device))]


def _apart(got: list[Tensor], want: list[Tensor]) -> float:
    """Root mean square of the difference relative to that of `want`, of the worst output."""
    shares = [
        ((g - w).square().mean() / w.square().mean()).sqrt().item()
        for g, w in zip(got, want, strict=True)
    ]
    return math.inf if any(map(math.isnan, shares)) else max(shares)


def _error(value: float, engine: str, device: str, precision: str) -> float:
    rows = torch.full_like(_random_rows(0), value)
    with torch.no_grad():
        want = [x.double() for x in _renderer().network(*_placed(rows, "cpu"))]
    return _apart(_outputs(engine, device, precision, rows), want)


def _not_finite(engine: str, device: str, precision: str) -> float:
    """How many values of the output are not finite."""
    outputs = _outputs(engine, device, precision, 2e4 * _random_rows(0))
    return float(sum((~x.isfinite()).sum() for x in outputs))


def _not_saturated(engine: str, device: str, precision: str) -> float:
    """How many values of the output change when inputs out of range double."""
    rows = _random_rows(0).sign() * 4
    once, twice = (_outputs(engine, device, precision, factor * rows) for factor in (1, 2))
    return float(sum((a != b).sum() for a, b in zip(once, twice, strict=True)))


def _spread_of_nan(engine: str, device: str, precision: str) -> float:
    rows = _random_rows(0)
    want = _outputs(engine, device, precision, rows)
    rows[0] = torch.nan
    got = _outputs(engine, device, precision, rows)
    if precision != "int8" and not all(x[0].isnan().all() for x in got):
        return math.inf
    cell = torch.arange(SIDE**2)
    far = (cell // SIDE > BLOCKS) | (cell % SIDE > BLOCKS)
    return _apart([x[far] for x in got], [x[far] for x in want])

"""Test cases of the engines: constant inputs, values far out of the calibration range, NaN."""

import math
import tempfile
from collections.abc import Callable, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from bench.case import Case, Cases, Cell, Random
from bench.console import ConsoleLog
from methods.engines import Engine
from methods.engines.openvino_engine import OpenVino
from methods.engines.tensorrt_engine import TensorRt
from methods.engines.torch_engine import TorchEngine

KINDS: tuple[type[Engine], ...] = (TorchEngine, OpenVino, TensorRt)
CELLS: list[Cell] = [(kind.name, precision) for kind in KINDS for precision in kind.precisions]
TOLERANCE = {"fp32": 1e-5, "bf16": 0.03, "fp16": 0.03, "int8": 0.1}
SHARE = (
    "of the root mean square: fp32 adds hundreds of products in another order; below, numbers are "
    "rounded by 2^-8, or 1/510 of the range seen, before each of the layers"
)
COUNTED = "numbers of which that is not true are counted: 0"

CHANNELS, WIDTH = 18, 16
SIDE = 32  # pixels along a side of a picture
REACH = 6  # pixels that the first one reaches: 1, then 2 of half size, then 1


class _Hourglass(nn.Module):
    """All that a U-Net does: convolutions, ReLUs, pooling, pixels shuffled, channels joined."""

    def __init__(self) -> None:
        super().__init__()
        self.enter = nn.Conv2d(CHANNELS, WIDTH, 3, padding=1)
        self.narrow = nn.Conv2d(WIDTH, 2 * WIDTH, 3, padding=1)
        self.widen = nn.Conv2d(2 * WIDTH, 4 * WIDTH, 3, padding=1)
        self.leave = nn.Conv2d(2 * WIDTH, 3, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        full = self.enter(x).relu()
        half = self.narrow(functional.max_pool2d(full, 2)).relu()
        wide = functional.pixel_shuffle(self.widen(half), 2)
        return self.leave(torch.cat((wide, full), 1).relu())


def cases() -> Cases:
    """Constant inputs, values far outside the calibration range, a pixel of NaN."""
    shares = {cell: TOLERANCE[cell[1]] for cell in CELLS}
    exact = dict.fromkeys(CELLS, 0.0)
    int8 = {cell: 0.0 for cell in CELLS if cell[1] == "int8"}
    same, finite = "the output is that of the network", "the output is finite"
    saturates = "int8 saturates: twice as large, they give the same output, number by number"
    spread = "pixels out of its reach are unchanged"
    eight, nan = "inputs 8 times as large as in the calibration", "a pixel of NaN"

    def case(name: str, holds: str, why: str, tolerances: Any, error: Any) -> Case:
        # Engines take seconds to build.
        return Case("engine", name, holds, why, tolerances, error, slow=True)

    return [
        case("all inputs 0", same, SHARE, shares, partial(_error, 0.0)),
        case("all inputs 1/2", same, SHARE, shares, partial(_error, 0.5)),
        case("inputs up to 1e3", finite, COUNTED, exact, _not_finite),
        case(eight, saturates, COUNTED, int8, _not_saturated),
        case(nan, spread, SHARE, shares, _spread_of_nan),
    ]


def _network() -> nn.Module:
    """An untrained network; always the same weights."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return _Hourglass().requires_grad_(False)


def _random_inputs(seed: int) -> Tensor:
    """A random picture [1, C, H, W], of -1/2 to 1/2."""
    return Random(seed).share(1, CHANNELS, SIDE, SIDE) - 0.5


@cache
def _built(engine: str, device: str, precision: Any) -> Callable[[Tensor], Tensor]:
    """The network as an engine runs it, calibrated on random pictures. Raises `Unavailable` if the
    engine, or its precision, does not exist on `device`."""
    chosen = next(kind for kind in KINDS if kind.name == engine)(precision)
    chosen.check(torch.device(device))
    views = [_random_inputs(seed).to(device) for seed in range(4)]
    with tempfile.TemporaryDirectory() as folder:
        log = ConsoleLog(Path(folder), quiet=True)
        return chosen.build(_network().to(device), lambda: views, lambda: Path(folder), log).run


@torch.no_grad()
def _output(cell: Sequence[str], inputs: Tensor) -> Tensor:
    """The output for `inputs` of an engine, on a device, in a precision, as float64."""
    return _built(*cell)(inputs.to(cell[1])).cpu().double().clone()


def _apart(got: Tensor, want: Tensor) -> float:
    """Root mean square of the difference relative to that of `want`."""
    share = ((got - want).square().mean() / want.square().mean()).sqrt().item()
    return math.inf if math.isnan(share) else share


def _error(value: float, *cell: str) -> float:
    inputs = torch.full_like(_random_inputs(0), value)
    with torch.no_grad():
        want = _network()(inputs).double()
    return _apart(_output(cell, inputs), want)


def _not_finite(*cell: str) -> float:
    return float((~_output(cell, 2e3 * _random_inputs(0)).isfinite()).sum())


def _not_saturated(*cell: str) -> float:
    """How many numbers of the output change when inputs out of range double."""
    inputs = _random_inputs(0).sign() * 4
    once, twice = (_output(cell, factor * inputs) for factor in (1, 2))
    return float((once != twice).sum())


def _spread_of_nan(*cell: str) -> float:
    inputs = _random_inputs(0)
    want = _output(cell, inputs)
    inputs[..., 0, 0] = torch.nan
    far = torch.ones(SIDE, SIDE, dtype=torch.bool)
    far[: REACH + 1, : REACH + 1] = False
    return _apart(_output(cell, inputs)[..., far], want[..., far])

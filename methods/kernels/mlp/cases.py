"""Cases of the small network: one and two inputs, forward and backward, whole and odd widths.

Inputs, weights and gradients are small multiples of 1/8. Every sum then has at most 24 bits, so
that it is exact in any order, and no activation lies within rounding of the corner of a ReLU.
"""

import math

from torch import Tensor

from bench.case import Bound, Cases, Given, Operation, Random, placed
from methods.kernels.dispatch import served
from methods.kernels.mlp import mlp

Network = tuple[tuple[int, ...], tuple[int, ...]]

DENSITY, FEATURES = ((32,), (64, 16)), ((16, 16), (64, 64, 3))
"""Channels of the inputs, outputs of each layer: the networks of Instant-NGP."""

MANY = 1 << 17


def _eighths(random: Random, *shape: int, most: int = 8) -> Tensor:
    """Random multiples of 1/8, of at most `most`/8."""
    return random.whole(-most, most + 1, *shape) / 8


EXACT = Bound("sums of few bits: 0", 0.0)
MLP = Operation(
    "mlp",
    served(__package__),
    mlp,
    {"outputs": EXACT},
    {"inputs": EXACT, "weights": EXACT},
    _eighths,
)


def cases() -> Cases:
    """No sample, one, more than go together; a sample of NaN; many, timed; bfloat16."""
    kinds: list[tuple[int, Network, str]] = [
        (0, DENSITY, "fp32"),
        (1, FEATURES, "fp32"),
        (97, ((7, 4), (20, 5)), "fp32"),
        (1000, ((3,), (5,)), "fp32"),
        (1000, DENSITY, "fp32"),
        (1000, FEATURES, "fp32"),
        (97, FEATURES, "bf16"),
        (MANY, DENSITY, "fp32"),
        (MANY, FEATURES, "fp32"),
    ]
    found = []
    for count, network, precision in kinds:
        inputs, widths = (", ".join(map(str, channels)) for channels in network)
        name = f"{count:,} of {inputs} to {widths}" + ", bf16" * (precision == "bf16")
        given = count, network, precision
        found += MLP.cases(name, _network, *given, precision=precision, items=count)
    return [*found, *MLP.cases("a sample of NaN", _with_nan)]


def _network(count: int, network: Network, precision: str) -> Given:
    inputs, widths = network
    random = Random(count)
    channels = (sum(inputs), *widths)
    shapes = [(channels[n + 1], channels[n]) for n in range(len(widths))]
    drawn = {
        "inputs": [_eighths(random, count, part) for part in inputs],
        "weights": [_eighths(random, *shape, most=1) for shape in shapes],
    }
    return placed(drawn, "cpu", precision)


def _with_nan() -> Given:
    given = _network(97, FEATURES, "fp32")
    given["inputs"][1][50, 3] = math.nan
    return given

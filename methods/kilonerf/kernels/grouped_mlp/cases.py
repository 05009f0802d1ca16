"""Cases of the small networks: sorting, encoding, single layers and whole networks."""

import torch
from torch import Tensor

from bench.case import LEAST_TIMED, U32, Bound, Cases, Given, Operation, Random
from methods.kernels.dispatch import served
from methods.kilonerf.kernels.grouped_mlp import (
    HIDDEN,
    POSITION_FREQUENCIES,
    SHAPES,
    Networks,
    colours,
    densities,
    encode_frequencies,
    grouped_linear,
    locate,
    order,
)

KINDS = {
    "some samples without a network": (1000, 7),
    "no sample": (0, 3),
    "one sample": (1, 1),
    "fewer samples than go together": (5, 1),
    "most networks empty": (40, 300),
    "150 thousand in 250": (150_000, 250),
}
"""Numbers of samples and networks."""

ANGLES = 188 * U32
"""An angle of at most 512 is rounded by none, reduced with an error below 4 u, and its sine within
4 u; each of 4 doublings doubles the error and adds 4 u: 16 x 8 u + 60 u."""

EXACT = Bound("whole numbers: 0", 0.0)
LOCATE = Operation(
    "locate",
    served(__package__),
    locate,
    {
        "networks": Bound("a quotient is rounded alike by all: 0", 0.0),
        "positions": Bound("a quotient below 5 that is rounded once more: 8 u", 8 * U32),
    },
)
ORDER = Operation(
    "order",
    served(__package__),
    order,
    {"permutation": EXACT, "offsets": EXACT},
)
ENCODE = Operation(
    "encode frequencies",
    served(__package__),
    encode_frequencies,
    {"encoding": Bound("as `ANGLES` says", ANGLES)},
)


def _of_network(given: Given) -> Tensor:
    """How far sums over the samples of each network may be off, [N, 1]."""
    counts = given["offsets"].diff().double()[:, None]
    return 6 * counts.sqrt() * (counts + 1) * U32


OF_NETWORK = (
    "sums over n samples of a network, numbers of at most 1; 2 n independent roundings of partial "
    "sums of at most n: 6 sqrt(n) (n + 1) u (Higham, Mary 2019)"
)
LINEAR = Operation(
    "grouped linear",
    served(__package__),
    grouped_linear,
    {
        "outputs": Bound(
            "I products below 1 / 8 and a bias of at most 16, by both: 2 (I + 1) (I / 8 + 16) u",
            lambda given: 2 * (1 + (i := given["weights"].shape[1])) * (i / 8 + 16) * U32,
        )
    },
    {
        "inputs": Bound(
            "sums of O products below 1 / 8, by both: 2 O x O / 8 u",
            lambda given: given["weights"].shape[2] ** 2 / 4 * U32,
        ),
        "weights": Bound(OF_NETWORK, lambda given: _of_network(given)[:, None]),
        "biases": Bound(OF_NETWORK, _of_network),
    },
)


def _grown(off: float, *names: str) -> float:
    """How far the outputs of the last of some layers may be off, one after the other, whose inputs
    of at most 1 are `off`; weights and biases are at most 1 / 8. Each layer passes the errors of
    its inputs on, times its weights, and adds I + 1 u of the sum of their sizes, by both."""
    size = 1.0
    for name in names:
        inputs, _ = SHAPES[name]
        most = (inputs * size + 1) / 8
        off, size = inputs / 8 * off + 2 * (inputs + 1) * U32 * most, most
    return off


DENSITIES = Operation(
    "densities of networks",
    served(__package__),
    densities,
    {
        "densities": Bound(
            "three layers, as `_grown` says, of angles off by 188 u",
            _grown(ANGLES, "in", "mid", "density"),
        ),
        "geometry": Bound("the same, of two layers", _grown(ANGLES, "in", "mid")),
    },
)
COLOURS = Operation(
    "colours of networks",
    served(__package__),
    colours,
    {
        "colours": Bound(
            "three layers, as `_grown` says; a sigmoid has a quarter of it and 8 u of its own",
            _grown(0.0, "feature", "direction", "colour") / 4 + 8 * U32,
        )
    },
)


def cases() -> Cases:
    """Sorting, encoding, single layers forward and backward, and whole networks."""
    found = []
    for count in (0, 1, 1000, 1 << 18):
        found += LOCATE.cases(f"{count:,} positions", _placed, count, items=count)
        found += ENCODE.cases(f"{count:,} samples", _angles, count, items=count)
    for name, size in KINDS.items():
        count, _ = size
        found += ORDER.cases(name, _sorted, *size, items=count)
        found += DENSITIES.cases(name, _in_cubes, *size, items=count)
        found += COLOURS.cases(name, _seen, *size, items=count)
        for layer in ((63, 32), (32, 1), (5, 50)) if count < LEAST_TIMED else ((63, 32),):
            shape = "{}, {} to {}".format(name, *layer)
            found += LINEAR.cases(shape, _layer, *size, *layer, items=count)
    return found


def _uniform(seed: int, *shape: int) -> Tensor:
    return Random(seed).signed(*shape)


def _placed(count: int) -> Given:
    positions = 0.5 + 0.6 * _uniform(count, count, 3)  # some beyond the grid
    positions[: count // 9] = torch.nan
    cubes = (torch.arange(60, dtype=torch.int16).view(3, 4, 5) - 20).clamp(min=-1)
    corner, side = torch.tensor((0.1, 0.2, 0.0)), torch.tensor(0.2)
    return {"positions": positions, "cubes": cubes, "corner": corner, "side": side}


def _sorted(count: int, networks: int) -> Given:
    """A network, or -1 for none, for each sample."""
    return {"networks": Random(count).whole(-1, networks, count), "count": networks}


def _angles(count: int) -> Given:
    return {"inputs": _uniform(count, count, 3), "frequencies": POSITION_FREQUENCIES}


def _layer(count: int, networks: int, inputs: int, outputs: int) -> Given:
    """With a ReLU, biases keep sums away from 0, where rounding would decide."""
    _, offsets = order(**_sorted(count, networks), backend="reference")
    relu, biases = outputs > 3, _uniform(3, networks, outputs)
    return {
        "inputs": _uniform(1, int(offsets[-1]), inputs),
        "weights": _uniform(2, networks, inputs, outputs) / 8,
        "biases": biases.sign() * 16 if relu else biases / 8,
        "offsets": offsets,
        "relu": relu,
    }


def _few(networks: int) -> Networks:
    """Their weights are at most 1 / 8."""
    found = {}
    for n, (name, shape) in enumerate(SHAPES.items()):
        weights, biases = _uniform(10 + n, networks, *shape), _uniform(20 + n, networks, shape[1])
        found[name] = weights / 8, biases / 8
    return found


def _in_cubes(count: int, networks: int) -> Given:
    numbers = _sorted(count, networks)["networks"]
    return {"positions": _uniform(5, count, 3), "numbers": numbers, "networks": _few(networks)}


def _seen(count: int, networks: int) -> Given:
    numbers = _sorted(count, networks)["networks"][:, None].float()
    return {
        "geometry": torch.cat((_uniform(6, count, HIDDEN), numbers), dim=1),
        "encoded": _uniform(7, count, SHAPES["direction"][0] - HIDDEN),
        "networks": _few(networks),
    }

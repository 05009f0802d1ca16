"""The field: small networks, one for each cube of a grid that holds matter."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from bench.types import Probe, TwoTensors
from methods.kernels.types import Occupancy, joined, offsets_of
from methods.kilonerf.kernels.grouped_mlp import (
    DIRECTION_FREQUENCIES,
    SHAPES,
    Networks,
    colours,
    densities,
    encode_frequencies,
    locate,
)
from methods.students.fields import REACH, StudentField


@dataclass(frozen=True)
class Grid:
    """Cubes side by side, some of which have a network."""

    networks: Tensor  # [X, Y, Z] int16, the number of each cube's network, -1 for none
    corner: Tensor  # [3] lower corner of the first cube, in the unit cube
    side: Tensor  # [] side of a cube

    @property
    def count(self) -> int:
        """How many networks there are."""
        return int(self.networks.max()) + 1


@dataclass(frozen=True)
class Pieces:
    """Parts of occupied cells, each within the cube of one network, network by network."""

    low: Tensor  # [P, 3] corners, in the unit cube
    high: Tensor  # [P, 3]
    offsets: Tensor  # [N + 1] network n has pieces offsets[n] to offsets[n + 1]

    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        """Draw `count` random points for each network: [N * count, 3], network by network. All
        pieces of a network are equally likely, whatever their size."""
        device = self.low.device
        sizes = self.offsets.diff()
        shares = torch.rand(len(sizes), count, generator=generator, device=device)
        chosen = (shares * sizes[:, None]).long().clamp(max=sizes[:, None] - 1)
        chosen = (self.offsets[:-1, None] + chosen).flatten()
        within = torch.rand(len(chosen), 3, generator=generator, device=device)
        low, high = self.low[chosen], self.high[chosen]
        return low + within * (high - low)


def place_networks(occupancy: Occupancy, bounds: Tensor, along: int) -> tuple[Grid, Pieces]:
    """Cover `bounds` [2, 3] with cubes: `along` of them on its longest side, as few as possible on
    the others. Those that overlap occupied cells have a network; also returns these overlaps."""
    extent = bounds[1] - bounds[0]
    side = extent.max() / along * (1 + 1e-6)  # a little larger: no face is lost by rounding
    shape = (extent / side).ceil().int()
    corner = bounds[0].clone()
    device = bounds.device
    cells = occupancy.cells.nonzero()  # [C, 3]
    low = cells / occupancy.resolution
    high = (cells + 1) / occupancy.resolution
    first = ((low - corner) / side).floor().int()
    last = ((high - corner) / side).ceil().int() - 1
    parts = []
    # A cell that is crossed by a face lies in several cubes.
    reach = int((last - first).max()) + 1 if len(cells) else 1
    steps = torch.arange(reach, device=device)
    for shift in torch.cartesian_prod(steps, steps, steps):
        cube = first + shift.int()
        there = ((cube <= last) & (cube >= 0) & (cube < shape)).all(dim=1)
        cube = cube[there]
        start = corner + cube * side
        ends = torch.maximum(low[there], start), torch.minimum(high[there], start + side)
        parts.append((cube, *ends))
    cube, low, high = joined(parts)
    x, y, z = shape.tolist()
    index = (cube[:, 0] * y + cube[:, 1]) * z + cube[:, 2]
    used, number, counts = index.unique(return_inverse=True, return_counts=True)
    networks = torch.full((x, y, z), -1, dtype=torch.int16, device=device)
    networks.view(-1)[used.long()] = torch.arange(len(used), dtype=torch.int16, device=device)
    by_network = number.argsort(stable=True)
    offsets = offsets_of(counts)
    return Grid(networks, corner, side), Pieces(low[by_network], high[by_network], offsets)


class KiloField(StudentField):
    """Small networks on a `grid`, all alike at the beginning; density and colour are 0 where there
    is no network."""

    round_samples = 8  # measured: docs/log.md

    networks: Tensor
    corner: Tensor
    side: Tensor

    def __init__(self, grid: Grid, backend: str, generator: torch.Generator | None = None) -> None:
        super().__init__(backend)
        for name, value in vars(grid).items():
            self.register_buffer(name, value)
        self.weights, self.biases = nn.ParameterDict(), nn.ParameterDict()
        for name, (inputs, outputs) in SHAPES.items():
            # As in torch's linear layers: uniform, with a bound from the number of inputs.
            bound = 1 / math.sqrt(inputs)
            for kind, shape in ((self.weights, (inputs, outputs)), (self.biases, (outputs,))):
                values = torch.empty(*shape).uniform_(-bound, bound, generator=generator)
                kind[name] = nn.Parameter(values.repeat(grid.count, *[1] * len(shape)))

    def raw_density(self, positions: Tensor) -> TwoTensors:
        """Density [S] times `REACH` before its activation, and what `features` needs [S, 33]."""
        grid = self.networks, self.corner, self.side
        numbers, local = locate(positions, *grid, backend=self.backend)
        return densities(local, numbers, self._layers, backend=self.backend)

    def density(self, positions: Tensor) -> TwoTensors:
        raw, geometry = self.raw_density(positions)
        return raw.relu() / REACH, geometry

    def encode_directions(self, directions: Tensor) -> Tensor:
        """Encoding [R, 27] of the unit directions."""
        unit = functional.normalize(directions, dim=1)
        return encode_frequencies(unit, DIRECTION_FREQUENCIES, backend=self.backend)

    def features(self, geometry: Tensor, encoded: Tensor) -> Tensor:
        return colours(geometry, encoded, self._layers, backend=self.backend)

    def count(self, probe: Probe, samples: int, shaded: int) -> None:
        products = {name: inputs * outputs for name, (inputs, outputs) in SHAPES.items()}
        density = sum(products[name] for name in ("in", "mid", "density"))
        probe.count("products", density * samples + (sum(products.values()) - density) * shaded)

    def sizes(self) -> dict[str, int]:
        """Bytes of the networks, and of the grid that holds their numbers."""
        parameters = sum(parameter.numel() for parameter in self.parameters())
        return {"networks": 4 * parameters, "network_grid": 2 * self.networks.numel()}

    @property
    def _layers(self) -> Networks:
        return {name: (self.weights[name], self.biases[name]) for name in SHAPES}

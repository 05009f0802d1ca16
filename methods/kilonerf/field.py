"""The field: small networks, one for each cell of a grid that may hold matter."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from bench.types import Probe
from methods.kilonerf.grid import Grid
from methods.kilonerf.kernels.grouped_mlp import (
    HIDDEN,
    Networks,
    colours,
    densities,
    encode_frequencies,
    locate,
)
from methods.students.fields import REACH, StudentField

POSITION_FREQUENCIES = 10
DIRECTION_FREQUENCIES = 4

SHAPES = {
    "in": (3 + 6 * POSITION_FREQUENCIES, HIDDEN),
    "mid": (HIDDEN, HIDDEN),
    "density": (HIDDEN, 1),
    "feature": (HIDDEN, HIDDEN),
    "direction": (HIDDEN + 3 + 6 * DIRECTION_FREQUENCIES, HIDDEN),
    "colour": (HIDDEN, 3),
}
"""Inputs and outputs of a layer (Reiser et al. 2021, Figure 2): 6,212 parameters a network."""

DENSITY_LAYERS = ("in", "mid", "density")


class KiloField(StudentField):
    """Small networks on a grid; density and colour are 0 where there is no network.

    Args:
        grid: where the networks are.
        backend: backend of the kernels.
        generator: source of the weights, which are the same in all networks at the beginning.
    """

    round_samples = 8  # measured: docs/log.md

    networks: Tensor
    corner: Tensor
    side: Tensor

    def __init__(self, grid: Grid, backend: str, generator: torch.Generator | None = None) -> None:
        super().__init__(backend)
        self.register_buffer("networks", grid.networks)
        self.register_buffer("corner", grid.corner)
        self.register_buffer("side", grid.side)
        self.count_networks = grid.count
        self.weights, self.biases = nn.ParameterDict(), nn.ParameterDict()
        for name, (inputs, outputs) in SHAPES.items():
            # As in torch's linear layers: uniform, with a bound from the number of inputs.
            bound = 1 / math.sqrt(inputs)
            for kind, shape in ((self.weights, (inputs, outputs)), (self.biases, (outputs,))):
                values = torch.empty(*shape).uniform_(-bound, bound, generator=generator)
                kind[name] = nn.Parameter(values.repeat(self.count_networks, *[1] * len(shape)))

    def raw_density(self, positions: Tensor) -> tuple[Tensor, Tensor]:
        """Density [S] times `REACH` before its activation, and what `features` needs [S, 33]."""
        grid = self.networks, self.corner, self.side
        numbers, local = locate(positions, *grid, backend=self.backend)
        return densities(local, numbers, self._layers, backend=self.backend)

    def density(self, positions: Tensor) -> tuple[Tensor, Tensor]:
        """Density [S], and what `features` needs of each sample [S, 33]."""
        raw, geometry = self.raw_density(positions)
        return raw.relu() / REACH, geometry

    def encode_directions(self, directions: Tensor) -> Tensor:
        """Encoding [R, 27] of the unit directions."""
        unit = functional.normalize(directions, dim=1)
        return encode_frequencies(unit, DIRECTION_FREQUENCIES, backend=self.backend)

    def features(self, geometry: Tensor, encoded: Tensor) -> Tensor:
        """Colours [S, 3]."""
        return colours(geometry, encoded, self._layers, backend=self.backend)

    def count(self, probe: Probe, samples: int, shaded: int) -> None:
        products = {name: inputs * outputs for name, (inputs, outputs) in SHAPES.items()}
        density = sum(products[name] for name in DENSITY_LAYERS)
        probe.count("products", density * samples + (sum(products.values()) - density) * shaded)

    def sizes(self) -> dict[str, int]:
        """Bytes of the networks, and of the grid that holds their numbers."""
        parameters = sum(parameter.numel() for parameter in self.parameters())
        return {"networks": 4 * parameters, "network_grid": 2 * self.networks.numel()}

    @property
    def _layers(self) -> Networks:
        return Networks(dict(self.weights), dict(self.biases))

"""The network of NeRF, as a field."""

import torch
from torch import Tensor, nn

from bench.types import Probe, TwoTensors
from methods.instant_ngp.field import FieldPrecision
from methods.students.fields import REACH
from methods.students.networks import (
    DIRECTION_CHANNELS,
    Dense,
    NetworkField,
    density_of,
    encode_directions,
    positional,
    products,
)

WIDTH, LAYERS = 256, 8  # outputs of every layer of the trunk, and how many there are

SKIP = 5  # layers of the trunk after which the encoded position is concatenated again

VIEW_WIDTH = 128  # outputs of the layer that sees the direction

POSITION_FREQUENCIES = 10

DENSITY = 1 / REACH
"""Density at a network output of 1, chosen so that the weights are of the usual size."""


class NerfField(NetworkField):
    """One network of 595,844 parameters (Mildenhall et al. 2020, Figure 7). Positions in the unit
    cube are mapped to [-1, 1], as in Section 5.1. `precision` is that of the products, `backend`
    that of the kernels that render the field."""

    def __init__(
        self, precision: FieldPrecision, backend: str, generator: torch.Generator | None = None
    ) -> None:
        super().__init__(backend)
        position = 3 + 2 * 3 * POSITION_FREQUENCIES
        inputs = [position if layer == 0 else WIDTH for layer in range(LAYERS)]
        inputs[SKIP] += position
        self.trunk = nn.ModuleList(Dense(size, WIDTH, precision, generator) for size in inputs)
        self.opacity = Dense(WIDTH, 1, precision, generator)
        self.bottleneck = Dense(WIDTH, WIDTH, precision, generator)
        self.view = Dense(WIDTH + DIRECTION_CHANNELS, VIEW_WIDTH, precision, generator)
        self.colour = Dense(VIEW_WIDTH, 3, precision, generator)

    def density_together(self, positions: Tensor) -> TwoTensors:
        encoded = positional(2 * positions - 1, POSITION_FREQUENCIES)
        hidden = encoded
        for number, layer in enumerate(self.trunk):
            if number == SKIP:
                hidden = torch.cat((encoded.to(hidden.dtype), hidden), dim=1)
            hidden = layer(hidden).relu_()
        return DENSITY * density_of(self.opacity(hidden)[:, 0].to(positions.dtype)), hidden

    encode_directions = staticmethod(encode_directions)

    def colours_together(self, geometry: Tensor, encoded: Tensor) -> Tensor:
        # No activation separates the bottleneck and the layer that sees the direction: one product
        # with their merged weights saves two thirds of the work of a colour.
        of_feature, of_direction = self.view.weight.split((WIDTH, encoded.shape[1]), dim=1)
        weight = torch.cat((of_feature @ self.bottleneck.weight, of_direction), dim=1)
        bias = self.view.bias + of_feature @ self.bottleneck.bias
        inputs = torch.cat((geometry, encoded.to(geometry.dtype)), dim=1)
        hidden = self.view.forward_with(inputs, weight, bias).relu_()
        return self.colour(hidden).to(encoded.dtype).sigmoid()

    def count(self, probe: Probe, samples: int, shaded: int) -> None:
        density, colour = products(self.trunk, self.opacity), products(self.view, self.colour)
        probe.count("products", density * samples + colour * shaded)

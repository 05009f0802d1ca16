"""The decoder of DIVeR32: integrated features to an opacity and a colour (Wu et al. 2022, 3.3)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from methods.diver.kernels.segments import Layers
from methods.students.networks import positional

CHANNELS = 32
"""Features of a corner, and width of every layer between input and output."""

FREQUENCIES = 4
DIRECTION_CHANNELS = 3 + 2 * 3 * FREQUENCIES


def encode_directions(directions: Tensor) -> Tensor:
    """Unit vectors of ray `directions` [R, 3], with sines and cosines of pi, 2 pi, 4 pi and 8 pi
    times them: [R, 27]."""
    return positional(functional.normalize(directions, dim=-1), FREQUENCIES)


class Decoder(nn.Module):
    """A 32-32-32-33 network of integrated features, and a (32 + 27)-32-3 network of its last 32
    outputs and the direction. ReLU between the layers of each, but not between the two."""

    def __init__(self, generator: torch.Generator | None = None) -> None:
        super().__init__()
        self.first = _linear(CHANNELS, CHANNELS, generator)
        self.second = _linear(CHANNELS, CHANNELS, generator)
        self.third = _linear(1 + CHANNELS, CHANNELS, generator)
        self.view = _linear(CHANNELS, CHANNELS + DIRECTION_CHANNELS, generator)
        self.colour = _linear(3, CHANNELS, generator)

    def density(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Density [S], integrated over the segment, before its ReLU; and what `colours` needs
        [S, 32]."""
        hidden = self.second(self.first(features).relu()).relu()
        sigma, geometry = self.third(hidden).split((1, CHANNELS), dim=1)
        return sigma.squeeze(1), geometry

    def colours(self, geometry: Tensor, encoded: Tensor, ray: Tensor) -> Tensor:
        """RGB [S, 3] in [0, 1] on rays `ray` [S] of encoded directions [R, 27]."""
        along, across = self.view.weight.split((CHANNELS, DIRECTION_CHANNELS), dim=1)
        # This layer is linear: the product of the directions is computed only once per ray.
        towards = functional.linear(encoded, across, self.view.bias)
        hidden = functional.linear(geometry, along) + towards.index_select(0, ray)
        return self.colour(hidden.relu()).sigmoid()


def _linear(outputs: int, inputs: int, generator: torch.Generator | None) -> nn.Linear:
    layer = nn.utils.skip_init(nn.Linear, inputs, outputs)
    bound = (6 / (inputs + outputs)) ** 0.5
    nn.init.uniform_(layer.weight, -bound, bound, generator=generator)
    nn.init.zeros_(layer.bias)
    return layer


@dataclass(frozen=True)
class Merged:
    """The same decoder, for features to which the first layer was already applied at the corners.

    Integration is linear and its weights add up to 1, so the first layer may come before it. No
    ReLU separates the 32 outputs from the layer of the directions: the two are merged.

    Attributes:
        layers: from integrated features to density and colour.
        across, view_bias: [32, 27], [32] of the encoded direction.
    """

    layers: Layers
    across: Tensor
    view_bias: Tensor

    @classmethod
    @torch.no_grad()
    def of(cls, decoder: Decoder) -> Merged:
        """From a trained decoder."""
        along, across = decoder.view.weight.split((CHANNELS, DIRECTION_CHANNELS), dim=1)
        third, bias = decoder.third.weight, decoder.third.bias
        layers = Layers(
            hidden=decoder.second.weight.clone(),
            hidden_bias=decoder.second.bias.clone(),
            density=third[:1].clone(),
            density_bias=bias[:1].clone(),
            geometry=along @ third[1:],
            colour=decoder.colour.weight.clone(),
            colour_bias=decoder.colour.bias.clone(),
        )
        return cls(layers, across.clone(), decoder.view.bias + along @ bias[1:])

    def towards(self, directions: Tensor) -> Tensor:
        """What ray `directions` [R, 3] add to the layer of the colour: [R, 32]."""
        return functional.linear(encode_directions(directions), self.across, self.view_bias)

    def numel(self) -> int:
        """Number of parameters."""
        parts = (*vars(self.layers).values(), self.across, self.view_bias)
        return sum(tensor.numel() for tensor in parts)

"""The decoder of DIVeR32: integrated features to an opacity and a colour (Wu et al. 2022, 3.3)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from methods.students.networks import positional

CHANNELS = 32
"""Features of a corner, and of every layer between input and output."""

FREQUENCIES = 4
DIRECTION_CHANNELS = 3 + 2 * 3 * FREQUENCIES


def encode_directions(directions: Tensor) -> Tensor:
    """Unit vectors of ray `directions` [R, 3], with sines and cosines of pi, 2 pi, 4 pi and 8 pi
    times them: [R, 27]."""
    return positional(functional.normalize(directions, dim=-1), FREQUENCIES)


class Decoder(nn.Module):
    """A network 32-32-32-33 of integrated features, and one (32 + 27)-32-3 of the last 32 outputs
    and the direction. ReLU between the layers of either; none where the second begins."""

    def __init__(self, generator: torch.Generator | None = None) -> None:
        super().__init__()
        self.first = _linear(CHANNELS, CHANNELS, generator)
        self.second = _linear(CHANNELS, CHANNELS, generator)
        self.third = _linear(1 + CHANNELS, CHANNELS, generator)
        self.view = _linear(CHANNELS, CHANNELS + DIRECTION_CHANNELS, generator)
        self.colour = _linear(3, CHANNELS, generator)

    def density(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Density [S], integrated over the segment, before its ReLU; what `colours` needs
        [S, 32]."""
        hidden = self.second(self.first(features).relu()).relu()
        sigma, geometry = self.third(hidden).split((1, CHANNELS), dim=1)
        return sigma.squeeze(1), geometry

    def colours(self, geometry: Tensor, encoded: Tensor, ray: Tensor) -> Tensor:
        """RGB [S, 3] in [0, 1] on rays `ray` [S] of encoded directions [R, 27]."""
        along, across = self.view.weight.split((CHANNELS, DIRECTION_CHANNELS), dim=1)
        # Directions enter after the last product of positions: theirs is due once a ray.
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
    """The same decoder for features that the first layer was applied to at the corners.

    Integration is linear and its weights add up to 1, so the first layer may come before it. No
    ReLU stands between the 32 outputs and the layer of the directions: their product is one.

    Attributes:
        second, second_bias: [32, 32], [32].
        sigma, sigma_bias: [1, 32], [1].
        along, across, view_bias: [32, 32], [32, 27], [32].
        colour, colour_bias: [3, 32], [3].
    """

    second: Tensor
    second_bias: Tensor
    sigma: Tensor
    sigma_bias: Tensor
    along: Tensor
    across: Tensor
    view_bias: Tensor
    colour: Tensor
    colour_bias: Tensor

    @classmethod
    @torch.no_grad()
    def of(cls, decoder: Decoder) -> Merged:
        """From a trained decoder."""
        along, across = decoder.view.weight.split((CHANNELS, DIRECTION_CHANNELS), dim=1)
        third, bias = decoder.third.weight, decoder.third.bias
        return cls(
            decoder.second.weight.clone(),
            decoder.second.bias.clone(),
            third[:1].clone(),
            bias[:1].clone(),
            along @ third[1:],
            across.clone(),
            decoder.view.bias + along @ bias[1:],
            decoder.colour.weight.clone(),
            decoder.colour.bias.clone(),
        )

    def numel(self) -> int:
        """Numbers in it."""
        return sum(tensor.numel() for tensor in vars(self).values())

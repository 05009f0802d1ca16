"""Fields whose surface is known, in place of a trained one."""

from collections.abc import Callable

import torch
from torch import Tensor

from bench.types import Probe
from methods.rendering.field import ROUND_SAMPLES

DENSITY = 1000.0
"""Of what is solid: 7 thousandths of the cube let exp(-7) through."""

Shape = Callable[[Tensor], Tensor]


class Solid:
    """A field dense where any of `shapes` is > 0, of up to 4 features in [0, 1] of the place."""

    backend = "cpu"
    round_samples = ROUND_SAMPLES

    def __init__(self, *shapes: Shape, density: float = DENSITY, channels: int = 4) -> None:
        self.shapes, self.solid, self.channels = shapes, density, channels

    @property
    def device(self) -> torch.device:
        return torch.device("cpu")

    def density(self, positions: Tensor) -> tuple[Tensor, Tensor]:
        inside = torch.stack([shape(positions) > 0 for shape in self.shapes]).any(dim=0)
        return self.solid * inside, positions

    def features(self, geometry: Tensor, encoded: Tensor) -> Tensor:
        values = torch.cat((geometry.clamp(0, 1), torch.full_like(geometry[:, :1], 0.25)), dim=1)
        return values[:, : self.channels]

    def encode_directions(self, directions: Tensor) -> Tensor:
        return directions

    def count(self, probe: Probe, samples: int, shaded: int) -> None:
        """It takes no work."""


def ball(radius: float = 0.3) -> Shape:
    return lambda x: radius - (x - 0.5).norm(dim=-1)


def slab(begin: float, end: float, until_y: float = 1.0) -> Shape:
    """From x = `begin` to `end`, as far as y = `until_y`."""
    return lambda p: torch.stack((p[:, 0] - begin, end - p[:, 0], until_y - p[:, 1])).amin(dim=0)


def wall(begin: float) -> Shape:
    """Everything from x = `begin` on."""
    return slab(begin, 2.0)

"""Where the networks are: in those cubes of a grid around the scene that hold matter."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from methods.kernels.types import Occupancy


@dataclass(frozen=True)
class Grid:
    """Cubes side by side, some of which have a network.

    Attributes:
        networks: [X, Y, Z] int16, the number of each cube's network, -1 for none.
        corner: [3] lower corner of the first cube, in the unit cube.
        side: [] side of a cube.
    """

    networks: Tensor
    corner: Tensor
    side: Tensor

    @property
    def count(self) -> int:
        """How many networks there are."""
        return int(self.networks.max()) + 1


@dataclass(frozen=True)
class Pieces:
    """Parts of occupied cells, each within the cube of one network.

    Attributes:
        low, high: [P, 3] corners, in the unit cube, network by network.
        offsets: [N + 1] network n has pieces offsets[n] to offsets[n + 1].
    """

    low: Tensor
    high: Tensor
    offsets: Tensor

    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        """Draw `count` random points for each network: [N * count, 3], network by network.

        All pieces of a network are equally likely, whatever their size.
        """
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
    the others.

    A cube has a network if it overlaps an occupied cell.

    Returns:
        the cubes, and the occupied parts of those that have a network.
    """
    extent = bounds[1] - bounds[0]
    side = extent.max() / along * (1 + 1e-6)  # a little larger: no face is lost by rounding
    shape = (extent / side).ceil().int()
    corner, device = bounds[0].clone(), bounds.device
    cells = occupancy.cells.nonzero()  # [C, 3]
    low, high = cells / occupancy.resolution, (cells + 1) / occupancy.resolution
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
        part = torch.maximum(low[there], start), torch.minimum(high[there], start + side)
        parts.append((cube, *part))
    cube, low, high = (torch.cat(part) for part in zip(*parts, strict=True))
    x, y, z = shape.tolist()
    used, number, counts = ((cube[:, 0] * y + cube[:, 1]) * z + cube[:, 2]).unique(
        return_inverse=True, return_counts=True
    )
    networks = torch.full((x, y, z), -1, dtype=torch.int16, device=device)
    networks.view(-1)[used.long()] = torch.arange(len(used), dtype=torch.int16, device=device)
    by_network = number.argsort(stable=True)
    offsets = torch.cat((counts.new_zeros(1), counts.cumsum(dim=0)))
    return Grid(networks, corner, side), Pieces(low[by_network], high[by_network], offsets)

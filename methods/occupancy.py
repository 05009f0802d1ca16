"""Learning where a field is empty: a decaying maximum of its density on a grid of cells.

As in Instant-NGP (appendix E.2) and ngp_pl: every `EVERY` steps the density is sampled at random
points of some cells, cell <- max(DECAY * cell, density), and a cell counts as occupied when it
exceeds min(mean of the cells, the density that is opaque to 1 % over one step).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from methods.fields import HashField
from methods.kernels.march import MAX_SAMPLES, Occupancy

RESOLUTION = 128
STEP = math.sqrt(3) / MAX_SAMPLES
"""World length of a ray-marching step: the cube's diagonal in 1024 steps."""
EVERY = 16
WARMUP_STEPS = 256
DECAY = 0.95
MIN_ALPHA = 0.01
THRESHOLD = MIN_ALPHA / STEP
CHUNK = 1 << 18


class DensityGrid:
    """Running density of [G, G, G] cells of the unit cube and the occupancy that follows from it.

    Cells outside `bounds` [2, 3] stay empty for ever.
    """

    def __init__(self, bounds: Tensor, device: torch.device | str = "cpu") -> None:
        self.density = torch.zeros(RESOLUTION, RESOLUTION, RESOLUTION, device=device)
        edge = torch.arange(RESOLUTION, device=device) / RESOLUTION
        lower, upper = bounds.to(device)
        inside = (edge[:, None] + 1 / RESOLUTION > lower) & (edge[:, None] < upper)  # [G, 3]
        x, y, z = inside.unbind(dim=1)
        self._inside = x[:, None, None] & y[:, None] & z
        self._candidates = self._inside.flatten().nonzero().squeeze(1)
        self.occupancy = Occupancy(self._inside)

    def restore(self, density: Tensor) -> None:
        """Take over the density of a checkpoint."""
        self.density.copy_(density)
        self._threshold()

    @torch.no_grad()
    def update(self, field: HashField, generator: torch.Generator, samples: int | None) -> None:
        """Sample every candidate cell once (`samples` None) or `samples` of them.

        Half of the samples go to cells drawn from all candidates, half to occupied ones.
        """
        cells = self._candidates if samples is None else self._draw(samples, generator)
        found = torch.zeros_like(self.density).view(-1)
        for part in cells.split(CHUNK):
            corner = torch.stack(torch.unravel_index(part, self.density.shape), dim=-1)
            jitter = torch.rand(len(part), 3, generator=generator, device=part.device)
            sigma, _ = field.density((corner + jitter) / RESOLUTION)
            found.scatter_reduce_(0, part, sigma, "amax")
        self.density.mul_(DECAY)
        torch.maximum(self.density, found.view_as(self.density), out=self.density)
        self._threshold()

    def _draw(self, samples: int, generator: torch.Generator) -> Tensor:
        device = self.density.device
        occupied = self.occupancy.cells.flatten().nonzero().squeeze(1)
        pools = [pool for pool in (self._candidates, occupied) if len(pool)]
        return torch.cat(
            [
                pool[torch.randint(len(pool), (samples // 2,), generator=generator, device=device)]
                for pool in pools
            ]
        )

    def _threshold(self) -> None:
        mean = self.density.view(-1)[self._candidates].mean().item()
        self.occupancy = Occupancy((self.density > min(mean, THRESHOLD)) & self._inside)

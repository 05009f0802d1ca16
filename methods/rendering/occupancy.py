"""Occupancy grid of a field in training: a decaying maximum of its density in each cell.

After Instant-NGP (appendix E.2): every `EVERY` steps the density is sampled at random points of
some cells, and a cell counts as occupied when its running maximum exceeds min(mean of the cells,
the density that is opaque to 1 % over one step). Four things differ. A cell's value decays only
when the cell is visited, so that cells that were not sampled are not forgotten, and then faster:
to 0.8 instead of 0.95. All cells start out occupied, one visit away from being empty, so that the
whole grid need not be sampled at first. Only cells within the bounds of the scene that two cameras
see can be occupied, and none close to a camera (`learnable_cells`).
"""

import math

import torch
from torch import Tensor

from bench.cameras import place_camera, project, within
from bench.types import Cameras
from methods.kernels.march import MAX_SAMPLES
from methods.kernels.march.contraction import contract, expand, stretch
from methods.kernels.types import BRICK, Occupancy
from methods.rendering.field import CHUNK_SAMPLES, LOG_DENSITY_CLAMP, Field

RESOLUTION = 128
STEP = math.sqrt(3) / MAX_SAMPLES
"""World length of a ray-marching step: the cube's diagonal in 1024 steps."""

EVERY = 16  # training steps between two updates

DECAY = 0.8  # factor by which a visit reduces a cell's value, if it finds no higher density

MIN_ALPHA = 0.01
THRESHOLD = MIN_ALPHA / STEP  # density that is opaque to `MIN_ALPHA` over one step

INITIAL = 1.2 * THRESHOLD
"""Value of a cell before its first visit: a visit that finds nothing empties the cell."""

LARGEST = math.exp(LOG_DENSITY_CLAMP)
"""Higher densities are stored as this value, so that they can decay: infinity does not."""

DISTANT = 0.375  # from the middle of the cube: two half sides of the box

MIN_VIEWS = 2  # training cameras that must see a place before it may count as occupied


def learnable_cells(bounds: Tensor, cameras: Cameras, contracted: bool = False) -> Tensor:
    """Cells [G, G, G] that the pictures of `cameras` can show to be empty or not.

    They overlap `bounds` [2, 3] and lie in a brick of 4^3 cells that at least `MIN_VIEWS` cameras
    have in their picture: what only one camera sees could be anywhere along its rays, and training
    would put it right in front of that camera. Bricks at most one brick away from a camera are left
    out as well. In contracted space, all bricks beyond `DISTANT` are in: they are so large that a
    picture shows parts of them without their middle, and something must be behind everything.
    """
    device = bounds.device
    edge = torch.arange(RESOLUTION, device=device) / RESOLUTION
    lower, upper = bounds
    x, y, z = ((edge[:, None] + 1 / RESOLUTION > lower) & (edge[:, None] < upper)).unbind(dim=1)
    inside = x[:, None, None] & y[:, None] & z

    side = RESOLUTION // BRICK
    axis = (torch.arange(side, device=device) + 0.5) / side
    centres = torch.cartesian_prod(axis, axis, axis)
    points = expand(centres) if contracted else centres
    views = torch.zeros(len(centres), dtype=torch.int32, device=device)
    free = torch.ones(len(centres), dtype=torch.bool, device=device)
    for camera in cameras:
        camera = place_camera(camera, device)
        pixels, depth = project(camera, points)
        views += (depth > 0) & within(pixels, *camera.size)
        at = contract(camera.centre) if contracted else camera.centre
        free &= (centres - at).abs().amax(dim=1) > 1.5 / side
    known = views >= MIN_VIEWS
    if contracted:
        known |= (centres - 0.5).abs().amax(dim=1) > DISTANT
    bricks = (known & free).view(side, side, side)
    for dim in range(3):
        bricks = bricks.repeat_interleave(BRICK, dim=dim)
    return inside & bricks


class DensityGrid:
    """The running maximum of the density in [G, G, G] cells of the unit cube, and their occupancy.
    Only `cells` [G, G, G] bool may ever be occupied. In `contracted` space densities are per length
    in the cube, as long as a ray's steps are there."""

    def __init__(self, cells: Tensor, contracted: bool = False) -> None:
        self.density = INITIAL * cells.float()
        self._candidates = cells.flatten().nonzero().squeeze(1)
        self.occupancy = Occupancy(cells, contracted)

    def restore(self, density: Tensor) -> None:
        """Restore the density of a checkpoint."""
        self.density.copy_(density)
        self._threshold()

    @torch.no_grad()
    def update(self, field: Field, generator: torch.Generator, samples: int) -> None:
        """Visit `samples` random cells: half drawn from all cells, half from the occupied ones."""
        cells = self._draw(samples, generator)
        parts = cells.split(CHUNK_SAMPLES)
        sigma = torch.cat([self._visit(field, part, generator) for part in parts])
        density = self.density.view(-1)
        values = torch.fmax(DECAY * density[cells], sigma.clamp(max=LARGEST))  # not NaN
        density.scatter_reduce_(0, cells, values, "amax", include_self=False)
        self._threshold()

    def _visit(self, field: Field, cells: Tensor, generator: torch.Generator) -> Tensor:
        """Density at a random point of each of `cells` [N]."""
        # Not `torch.unravel_index`: it checks the largest index, and waits for a GPU.
        rows, columns = self.density.shape[1:]
        place = cells // (rows * columns), cells // columns % rows, cells % columns
        corner = torch.stack(place, dim=-1)
        jitter = torch.rand(len(cells), 3, generator=generator, device=cells.device)
        places = (corner + jitter) / RESOLUTION
        sigma = field.density(places)[0]
        return sigma * stretch(places) if self.occupancy.contracted else sigma

    def _draw(self, samples: int, generator: torch.Generator) -> Tensor:
        device = self.density.device
        occupied = self.occupancy.cells.flatten().nonzero().squeeze(1)
        pools = [pool for pool in (self._candidates, occupied) if len(pool)]
        count = (samples // 2,)
        drawn = (torch.randint(len(p), count, generator=generator, device=device) for p in pools)
        return torch.cat([pool[index] for pool, index in zip(pools, drawn, strict=True)])

    def _threshold(self) -> None:
        mean = self.density.sum() / len(self._candidates)  # others have a density of 0
        cells = self.density > mean.clamp(max=THRESHOLD)
        self.occupancy = Occupancy(cells, self.occupancy.contracted)

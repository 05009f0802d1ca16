"""Where a teacher has something, on a finer grid than the one that it learned with."""

from __future__ import annotations

import torch

from methods.instant_ngp.stage1 import TrainedField
from methods.kernels.march import Occupancy
from methods.rendering.occupancy import CHUNK, THRESHOLD

PROBES = 2
"""A cell is probed at so many points along each axis."""


@torch.no_grad()
def finer(teacher: TrainedField, resolution: int) -> Occupancy:
    """The cells of a grid of `resolution` a side, within the teacher's occupied ones, in which the
    teacher's density anywhere on a lattice of `PROBES`^3 points exceeds its usual threshold.

    A large network costs more than this look at every cell, and evaluates fewer samples then.

    Raises:
        ValueError: the resolution is no multiple of the teacher's.
    """
    coarse = teacher.occupancy
    times = resolution // coarse.resolution
    if times < 1 or resolution % coarse.resolution:
        raise ValueError(
            f"cells: expected a multiple of the {coarse.resolution} of the teacher, got {resolution}"
        )
    if times == 1:
        return coarse
    cells = coarse.cells
    for axis in range(3):
        cells = cells.repeat_interleave(times, dim=axis)
    candidates = cells.nonzero()
    inside = (torch.arange(PROBES, device=cells.device) + 0.5) / PROBES
    lattice = torch.cartesian_prod(inside, inside, inside)
    for some in candidates.split(CHUNK // len(lattice)):
        points = (some[:, None] + lattice).flatten(0, 1) / resolution
        sigma, _ = teacher.field.density(points)
        x, y, z = some.unbind(dim=1)
        cells[x, y, z] = (sigma.view(len(some), -1) > THRESHOLD).any(dim=1)
    return Occupancy(cells)

"""The ray march on rays that meet faces, edges and corners, or come from very far."""

from __future__ import annotations

import math
from functools import partial

import torch
from torch import Tensor

from bench.stress import StressCase
from methods.kernels.case import DTYPES, U32
from methods.kernels.march import MAX_SAMPLES, Occupancy, march

SIZE = 16
CELL = (3, 12, 8)
"""The one cell of a grid that is empty elsewhere."""

STEP = math.sqrt(3) / MAX_SAMPLES

AXES = torch.cat((torch.eye(3), -torch.eye(3)))
ALL = torch.cartesian_prod(*[torch.tensor([-1.0, 0.0, 1.0])] * 3)
ALL = ALL[ALL.any(dim=1)]


def cases() -> list[StressCase]:
    """Every kind of ray through a full grid, an empty one, and one with a single cell."""
    middle, corner, far = torch.full((3,), 0.5), torch.zeros(3), 1e6
    kinds: dict[str, tuple[Tensor, Tensor]] = {
        "along axes": (middle - 2 * AXES, AXES),
        "along diagonals": (middle - 2 * ALL, ALL),
        "in planes of the grid": (torch.tensor([[-1.0, 0.25, 0.5]]), AXES[:1]),
        "through a corner of the cube": (corner - 2 * ALL, ALL),
        "through an edge of the cube": (torch.tensor([0.0, 0.0, 0.5]) - 2 * ALL, ALL),
        "from inside": (middle.expand(26, 3), ALL),
        "from a face": (torch.tensor([0.0, 0.5, 0.5]).expand(26, 3), ALL),
        "from a corner": (corner.expand(26, 3), ALL),
        "away from the cube": (middle + 2 * AXES, AXES),
        "past the cube": (middle - 2 * AXES + 3 * AXES.roll(1, dims=1), AXES),
        "without direction": (middle.expand(1, 3), torch.zeros(1, 3)),
        "from 1e6 away": (middle - far * ALL, ALL),
        "of direction 1e-30": (middle - 2 * ALL, 1e-30 * ALL),
        "of direction 1e-40": (middle - 2 * ALL, 1e-40 * ALL),
        "from inside, of direction 1e-40": (middle.expand(26, 3), 1e-40 * ALL),
        "of direction 1e30": (middle - 2 * ALL, 1e30 * ALL),
        "of directions 1 and 1e-40": (middle - 2 * AXES, AXES + 1e-40 * AXES.roll(1, dims=1)),
        "along an edge, off it by 1e-40": (corner.expand(6, 3), AXES.abs() + 1e-40),
        "along an edge, off it by 1e-30": (corner.expand(6, 3), AXES.abs() + 1e-30),
    }
    found = []
    for grid, holds in (
        ("full grid", "samples add up to the way through the cube, and lie on it"),
        ("one cell", "samples add up to the way through the cell, and lie on it"),
        ("empty grid", "no samples"),
    ):
        for kind, rays in kinds.items():
            if "1e6" in kind and grid == "one cell":
                continue  # t is rounded there by as much as the cell measures
            size = rays[0].abs().max().item() + 1
            # An end of the way is rounded to a sample: half a step in the cube, where the first
            # sample lies half a step behind it, a step in the cell, at both ends.
            steps = {"full grid": 0.5, "one cell": 1.0, "empty grid": 0.0}[grid]
            rounding = 0.0 if grid == "empty grid" else 4 * math.sqrt(3) * size * U32
            cells = {(backend, "fp32"): steps * STEP + rounding for backend in ("reference", "cpu")}
            found.append(
                StressCase(
                    "march",
                    f"{kind}, {grid}",
                    holds,
                    f"{steps} steps, and t rounded 4 times at the size of the origin: 4 √3 |o| u",
                    cells,
                    partial(_way_error, grid, rays, STEP),
                )
            )
    fine = 1e-4
    found.append(
        StressCase(
            "march",
            "1024 samples reached",
            "going on from where a ray was left gives the rest of the way",
            "half a step, and t rounded 4 times at the size of the origin: 4 √3 |o| u",
            {(b, "fp32"): fine / 2 + 12 * math.sqrt(3) * U32 for b in ("reference", "cpu")},
            partial(_way_error, "full grid", kinds["along diagonals"], fine),
        )
    )
    return found


def _grid(kind: str) -> Occupancy:
    cells = torch.full((SIZE, SIZE, SIZE), kind == "full grid")
    if kind == "one cell":
        cells[CELL] = True
    return Occupancy(cells)


def _way(kind: str, origins: Tensor, directions: Tensor) -> Tensor:
    """World length of rays inside what the grid holds, by the slab test in float64; 0 where no
    number that rays have is large enough to be t."""
    if kind == "empty grid":
        return torch.zeros(len(origins), dtype=torch.float64)
    lower, upper = torch.zeros(3).double(), torch.ones(3).double()
    if kind == "one cell":
        lower = torch.tensor(CELL).double() / SIZE
        upper = lower + 1 / SIZE
    o, d = origins.double(), directions.double()
    ends = torch.stack(((lower - o) / d, (upper - o) / d))
    between = (o >= lower) & (o < upper) | (d != 0)
    enter = torch.where(d == 0, -torch.inf, ends.amin(0)).amax(1).clamp(min=0)
    leave = torch.where(d == 0, torch.inf, ends.amax(0)).amin(1)
    way = (leave - enter).clamp(min=0) * d.norm(dim=1)
    known = (o.abs().amax(1) + 1) / d.abs().amax(1) < torch.finfo(origins.dtype).max
    return torch.where(between.all(1) & known, way, 0)


def _way_error(
    grid: str,
    rays: tuple[Tensor, Tensor],
    step: float,
    backend: str,
    device: str,
    precision: str,
) -> float:
    """How far the samples, taken in as many calls as it takes, are from the way of their rays."""
    origins, directions = (x.to(device, DTYPES[precision]) for x in rays)
    occupancy = Occupancy(_grid(grid).cells.to(device))
    start = torch.zeros(len(origins), dtype=torch.int32, device=device)
    counts = torch.zeros(len(origins), dtype=torch.int64, device=device)
    outside = 0.0
    for _ in range(math.ceil(math.sqrt(3) / step / MAX_SAMPLES) + 1):
        samples = march(
            origins, directions, occupancy, step, start=start, limit=MAX_SAMPLES, backend=backend
        )
        counts += samples.offsets.diff()
        start = samples.resume
        if len(samples):
            beyond = (samples.positions - 0.5).abs().max().item() - 0.5
            outside = max(outside, beyond)
            same = samples.ray[1:] == samples.ray[:-1]
            if (samples.t.diff()[same] < 0).any():
                return math.inf
    if (start >= 0).any():
        return math.inf
    way = _way(grid, *(x.cpu() for x in (origins, directions)))
    return max((counts.cpu() * step - way).abs().max().item(), outside)

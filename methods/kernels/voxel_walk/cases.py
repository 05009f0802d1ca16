"""Cases of the voxel walk: bit-identical crossings by all backends; lengths against a slab test per
voxel; rays that hit faces, edges and corners, or come from far."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import normalize

from bench.case import DTYPES, Bound, Case, Given, Operation, Property, on_backends
from bench.types import Rays
from methods.kernels.dispatch import served
from methods.kernels.march.cases import ALL, AXES
from methods.kernels.voxel_walk import Voxels, walk

SIZE = 24
"""Resolution of the grids in most cases; not a power of two, so that planes are rounded."""

RESULTS = ("offsets", "ray", "voxel", "near", "far", "t", "delta", "resume")


def _walk(given: Given, backend: str) -> tuple[Tensor, ...]:
    crossings = walk(**given, backend=backend)
    return tuple(getattr(crossings, name) for name in RESULTS)


SAME = Bound("t of planes by the same operations, cells by comparing them: 0", 0.0)
WALK = Operation("voxel_walk", served(__package__), _walk, dict.fromkeys(RESULTS, SAME))


def cases() -> list[Case]:
    """Every kind of grid, ray, start and limit."""
    return [*_agreements(), *_lengths()]


def _agreements() -> Iterator[Case]:
    kinds: dict[str, dict[str, Any]] = {
        "limit 1": {"limit": 1, "grid": "full"},
        "no ray": {"count": 0},
        "one ray": {"count": 1},
        "inside and outside": {},
        "more rays than are walked together": {"count": 5000, "grid": "one"},
        "no voxel": {"grid": "empty"},
        "all voxels": {"count": 65, "grid": "full"},
        "one voxel": {"grid": "one"},
        "limit 7": {"limit": 7, "grid": "full"},
        "begun on the way": {"begun": True, "grid": "full"},
        "axes, planes, corners and what is not finite": {"count": None, "grid": "full"},
        "from 1e6 away": {"away": 1e6, "grid": "full"},
    }
    for name, kind in kinds.items():
        yield from WALK.cases(name, partial(_given, **kind))
    many = 1 << 13
    shell = partial(_given, count=many, grid="shell")
    yield from WALK.cases("hollow sphere in 128^3", shell, items=many)


def _given(
    count: int | None = 129,
    grid: str = "dust",
    away: float = 1.5,
    begun: bool = False,
    limit: int | None = None,
) -> Given:
    rays = _special_rays() if count is None else some_rays(count, away)
    start = None
    if begun:
        generator = torch.Generator().manual_seed(4)
        start = 2 * torch.rand(len(rays.origins), generator=generator) - 0.2
        start[:4] = torch.tensor([torch.inf, -torch.inf, torch.nan, 1e30])
    return {"rays": rays, "voxels": _grid(grid), "start": start, "limit": limit}


def _grid(kind: str) -> Voxels:
    size = 128 if kind == "shell" else SIZE
    cells, radius = all_cells(size)
    generator = torch.Generator().manual_seed(3)
    kept = {
        "empty": radius < 0,
        "full": radius >= 0,
        "one": (cells == torch.tensor([size - 1, 0, size // 2])).all(dim=1),
        "shell": (radius > 0.27) & (radius < 0.3),
        "dust": torch.rand(len(cells), generator=generator) < 0.05,
    }[kind]
    chosen = cells[kept]
    return Voxels(chosen[torch.randperm(len(chosen), generator=generator)], size)


def all_cells(size: int) -> tuple[Tensor, Tensor]:
    """The cells [G^3, 3] of a grid of G = `size`, and the distance of each from the middle."""
    cells = torch.cartesian_prod(*[torch.arange(size)] * 3)
    return cells, ((cells + 0.5) / size - 0.5).norm(dim=1)


def some_rays(count: int, away: float = 1.5) -> Rays:
    """Rays towards the cube from a sphere around it, every fourth from inside."""
    generator = torch.Generator().manual_seed(count)
    outside = normalize(torch.randn(count, 3, generator=generator), dim=-1) * away + 0.5
    inside = torch.rand(count, 3, generator=generator)
    origins = torch.where(torch.arange(count)[:, None] % 4 == 3, inside, outside)
    return Rays(origins, torch.rand(count, 3, generator=generator) - origins)


def _special_rays() -> Rays:
    """Rays along axes, diagonals, grid planes, through corners, without direction, not finite."""
    targets = torch.tensor([[0.5, 0.5, 0.5], [0.0, 0.0, 0.0], [1.0, 1.0, 0.5], [0.25, 0.3, 0.75]])
    far = targets[:, None] - 2 * ALL
    near = targets[:, None].expand_as(far)
    bad = torch.tensor(
        [[torch.nan, 0.5, 0.5], [0.5, torch.inf, 0.5], [0.5, 0.5, -1e30], [0.5, 0.5, 0.5]]
    )
    ahead = ALL.expand(4, 27, 3).reshape(-1, 3)
    last = torch.tensor([[1.0, 1.0, 1.0]] * 3 + [[torch.nan, 1.0, 1.0]])
    origins = torch.cat((far.reshape(-1, 3), near.reshape(-1, 3), bad))
    return Rays(origins, torch.cat((ahead, ahead, last)))


SOME = ALL[ALL.any(dim=1)]
MIDDLE = torch.full((3,), 0.5)
KINDS = {
    "from all around": some_rays(60),
    "along axes": Rays(MIDDLE + 0.01 - 2 * AXES, AXES),
    "along diagonals": Rays(MIDDLE - 2 * SOME, SOME),
    "through a corner of the cube": Rays(-2 * SOME, SOME),
    "from inside": Rays(MIDDLE.expand(26, 3) + 0.01, SOME),
    "from a face": Rays(torch.tensor([0.0, 0.49, 0.51]).expand(26, 3), SOME),
    "past the cube": Rays(MIDDLE - 2 * AXES + 3 * AXES.roll(1, dims=1), AXES),
    "without direction": Rays(MIDDLE.expand(1, 3), torch.zeros(1, 3)),
    "of direction 1e-30": Rays(MIDDLE + 0.01 - 2 * SOME, 1e-30 * SOME),
    "of direction 1e-40": Rays(MIDDLE - 2 * SOME, 1e-40 * SOME),
    "of direction 1e30": Rays(MIDDLE + 0.01 - 2 * SOME, 1e30 * SOME),
    "of directions 1 and 1e-40": Rays(
        MIDDLE + 0.01 - 2 * AXES, AXES + 1e-40 * AXES.roll(1, dims=1)
    ),
}


def _lengths() -> Iterator[Case]:
    """Every kind of ray through full, scattered, empty and one-voxel grids; also in rounds."""
    for grid in ("full", "dust", "one", "empty"):
        for kind, rays in KINDS.items():
            size = rays.origins.abs().max().item() + 1
            each = Property(
                "voxel_walk",
                "a length is that of a slab test of the voxel; voxels that touch share their t",
                "entry and exit of a voxel each rounded 4 times at the size of the origin, by a "
                "direction at most √3 as long as its largest component, and where edges and "
                "corners are cut as often again: 16 √3 |o| u",
                on_backends(16 * math.sqrt(3) * size),
            )
            for limit in (None, 3) if kind == "from all around" else (None,):
                name = f"{kind}, {grid}" + (f", {limit} at a time" if limit else "")
                yield each.case(name, partial(_length_error, grid, rays, limit))


def _there(grid: str, rays: Rays, device: str, precision: str) -> tuple[Rays, Voxels]:
    voxels, dtype = _grid(grid), DTYPES[precision]
    there = Voxels(voxels.coordinates.to(device), voxels.resolution)
    return Rays(rays.origins.to(device, dtype), rays.directions.to(device, dtype)), there


def _length_error(
    grid: str, given: Rays, limit: int | None, backend: str, device: str, precision: str
) -> float:
    """Largest error of a ray's length in a voxel, walked in rounds of `limit`.

    Infinite if crossings are not in order, or have gaps in the full grid.
    """
    rays, voxels = _there(grid, given, device, precision)
    lengths = torch.zeros(len(rays.origins), len(voxels) + 1, dtype=torch.float64)
    start = torch.zeros_like(rays.origins[:, 0])
    for _ in range(3 * SIZE if limit else 1):
        found = walk(rays, voxels, start=start, limit=limit, backend=backend)
        lengths.index_put_(
            (found.ray.long().cpu(), found.voxel.long().cpu()), found.delta.double().cpu(), True
        )
        start = found.resume
        same = found.ray[1:] == found.ray[:-1]
        gaps = (found.near[1:] - found.far[:-1])[same]
        if (gaps < 0).any() or (grid == "full" and gaps.any()) or (found.delta <= 0).any():
            return math.inf
    if (start != torch.inf).any():
        return math.inf
    errors = (lengths[:, :-1] - _exact_lengths(rays, voxels)).abs()
    return errors.amax().item() if len(voxels) else 0.0


def _exact_lengths(rays: Rays, voxels: Voxels) -> Tensor:
    """World length [R, V] of rays in voxels (slab test, float64); 0 where t overflows."""
    lower = voxels.coordinates.cpu().double() / voxels.resolution
    upper = lower + 1 / voxels.resolution
    o, d = rays.origins.cpu().double()[:, None], rays.directions.cpu().double()[:, None]
    a, b = (lower - o) / d, (upper - o) / d  # [R, V, 3]
    moves = (d != 0).expand_as(a)
    enter = torch.where(moves, torch.minimum(a, b), -torch.inf).amax(dim=2).clamp(min=0)
    leave = torch.where(moves, torch.maximum(a, b), torch.inf).amin(dim=2)
    between = (moves | (o >= lower) & (o < upper)).all(dim=2)
    largest = torch.finfo(rays.origins.dtype).max
    known = (o.abs().amax(dim=2) + 1) / d.abs().amax(dim=2) < largest
    length = (leave - enter).clamp(min=0) * d.norm(dim=2)
    return torch.where(between & known, length, 0)

"""Cases of the voxel walk: bit-identical crossings by all backends; lengths against a slab test per
voxel; rays that hit faces, edges and corners, or come from far."""

import math
from collections.abc import Iterator
from functools import partial
from typing import Any

import torch

from bench.case import Bound, Case, Cases, Given, Operation, Property, Random, on_backends, placed
from bench.types import Rays
from methods.kernels.dispatch import served
from methods.kernels.march.cases import SPECIAL, cells, slab_lengths, some_rays, special_rays
from methods.kernels.voxel_walk import Voxels, walk

SIZE = 24  # resolution of the grids in most cases; not a power of two, so that planes are rounded

RESULTS = ("offsets", "ray", "voxel", "near", "far", "t", "delta")

SAME = Bound("t of planes by the same operations, cells by comparing them: 0", 0.0)
WALK = Operation("voxel_walk", served(__package__), walk, dict.fromkeys(RESULTS, SAME))


def cases() -> Cases:
    """Every kind of grid and ray."""
    return [*_agreements(), *_lengths()]


def _agreements() -> Iterator[Case]:
    kinds: dict[str, dict[str, Any]] = {
        "no ray": {"count": 0},
        "one ray": {"count": 1},
        "inside and outside": {},
        "more rays than are walked together": {"count": 5000, "grid": "one"},
        "no voxel": {"grid": "empty"},
        "all voxels": {"count": 65, "grid": "full"},
        "one voxel": {"grid": "one"},
        "axes, planes, corners and what is not finite": {"count": None, "grid": "full"},
        "from 1e6 away": {"away": 1e6, "grid": "full"},
    }
    for name, kind in kinds.items():
        yield from WALK.cases(name, partial(_given, **kind))
    many = 1 << 13
    yield from WALK.cases("hollow sphere in 128^3", _given, many, "shell", items=many)


def _given(count: int | None = 129, grid: str = "dust", away: float = 1.5) -> Given:
    rays = special_rays() if count is None else some_rays(count, away)
    return {"rays": rays, "voxels": _grid(grid)}


def _grid(kind: str) -> Voxels:
    size = 128 if kind == "shell" else SIZE
    chosen = cells(kind, size).nonzero()
    return Voxels(chosen[torch.randperm(len(chosen), generator=Random(3).generator)], size)


def _lengths() -> Iterator[Case]:
    """Every kind of ray through full, scattered, empty and one-voxel grids."""
    kinds = {**SPECIAL, "from all around": some_rays(60)}
    for grid in ("full", "dust", "one", "empty"):
        for kind, rays in kinds.items():
            size = rays.origins.abs().max().item() + 1
            each = Property(
                "voxel_walk",
                "a length is that of a slab test of the voxel; voxels that touch share their t",
                "entry and exit of a voxel each rounded 4 times at the size of the origin, by a "
                "direction at most √3 as long as its largest component, and where edges and "
                "corners are cut as often again: 16 √3 |o| u",
                on_backends(16 * math.sqrt(3) * size),
            )
            yield each.case(f"{kind}, {grid}", _length_error, grid, rays)


def _length_error(grid: str, given: Rays, backend: str, device: str, precision: str) -> float:
    """Largest error of a ray's length in a voxel. Infinite if crossings are not in order, or have
    gaps in the full grid."""
    rays, voxels = placed((given, _grid(grid)), device, precision)
    found = walk(rays, voxels, backend=backend)
    same = found.ray[1:] == found.ray[:-1]
    gaps = (found.near[1:] - found.far[:-1])[same]
    if (gaps < 0).any() or (grid == "full" and gaps.any()) or (found.delta <= 0).any():
        return math.inf
    lengths = torch.zeros(len(rays.origins), len(voxels) + 1, dtype=torch.float64)
    places = found.ray.long().cpu(), found.voxel.long().cpu()
    lengths.index_put_(places, found.delta.double().cpu(), accumulate=True)
    lower = voxels.coordinates.cpu().double() / SIZE
    exact = slab_lengths(rays, lower, lower + 1 / SIZE)
    return (lengths[:, :-1] - exact).abs().amax().item() if len(voxels) else 0.0

"""Cases of the ray march: bit-identical samples by all backends; rays that hit faces, edges and
corners, or come from very far."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import normalize

from bench.case import DTYPES, U32, Agreement, Case, Property
from bench.types import Rays
from methods.kernels.dispatch import served
from methods.kernels.march import MAX_SAMPLES, march
from methods.kernels.types import Occupancy

STEP = math.sqrt(3) / MAX_SAMPLES
LONG = 4 * STEP  # for agreement: Triton's interpreter takes milliseconds per step
AXES = torch.cat((torch.eye(3), -torch.eye(3)))
ALL = torch.cartesian_prod(*[torch.tensor([-1.0, 0.0, 1.0])] * 3)  # [27, 3], one is 0

SIZE = 16
CELL = (3, 12, 8)
"""The only occupied cell of a grid."""

FINE = 1e-4
"""A step at which a ray has more than `MAX_SAMPLES` samples."""


def cases() -> list[Case]:
    """Every kind of ray, grid, window, phase and limit."""
    return [*_agreements(), *_ways()]


def _agreements() -> list[Case]:
    kinds: list[tuple[str, int, dict[str, Any]]] = [
        ("no ray", 0, {}),
        ("one ray", 1, {}),
        ("inside and outside", 129, {}),
        ("jitter", 129, {"jitter": True}),
        ("window", 129, {"window": True}),
        ("window without bounds", 129, {"unbounded": True}),
        ("resumed", 129, {"resumed": True}),
        ("limit 1", 129, {"limit": 1}),
        ("limit 7", 129, {"limit": 7}),
        ("empty grid", 65, {"grid": "empty"}),
        ("full grid", 65, {"grid": "full"}),
        ("one cell", 65, {"grid": "cell"}),
        ("scattered cells", 65, {"grid": "dust"}),
        ("axes, planes and corners", 0, {"special": True}),
    ]
    kernel = Agreement("march", served(__package__), "the same operations in the same order: 0")
    found = [kernel.case(name, partial(_prepare, rays, kind), 0.0) for name, rays, kind in kinds]
    timed = partial(_prepare, 1 << 13, {"grid": "shell", "step": STEP})
    return [*found, kernel.case("hollow sphere", timed, 0.0, items=1 << 13)]


def _grid(kind: str, device: str) -> Occupancy:
    size = 128 if kind == "shell" else 32
    axis = (torch.arange(size) + 0.5) / size - 0.5
    radius = (axis[:, None, None] ** 2 + axis[:, None] ** 2 + axis**2).sqrt()
    cells = {
        "empty": radius < 0,
        "full": radius >= 0,
        "cell": torch.zeros(size, size, size, dtype=torch.bool),
        "shell": (radius > 0.27) & (radius < 0.3),
        "dust": torch.rand(size, size, size, generator=torch.Generator().manual_seed(3)) < 0.02,
    }[kind]
    if kind == "cell":
        cells[size - 1, 0, size // 2] = True
    return Occupancy(cells.to(device))


def _rays(count: int) -> Rays:
    """Rays towards the cube from a sphere around it, every fourth from inside."""
    generator = torch.Generator().manual_seed(count)
    outside = normalize(torch.randn(count, 3, generator=generator), dim=-1) * 1.5 + 0.5
    inside = torch.rand(count, 3, generator=generator)
    origins = torch.where(torch.arange(count)[:, None] % 4 == 3, inside, outside)
    return Rays(origins, torch.rand(count, 3, generator=generator) - origins)


def _special_rays() -> Rays:
    """Rays along axes, diagonals, grid planes, through corners, without direction, not finite."""
    targets = torch.tensor([[0.5, 0.5, 0.5], [0.0, 0.0, 0.0], [1.0, 1.0, 0.5], [0.25, 0.3, 0.75]])
    far = targets[:, None] - 2 * ALL
    near = targets[:, None].expand_as(far)
    bad = torch.tensor([[torch.nan, 0.5, 0.5], [0.5, torch.inf, 0.5], [0.5, 0.5, -1e30]])
    origins = torch.cat((far.reshape(-1, 3), near.reshape(-1, 3), bad))
    ahead = ALL.expand(4, 27, 3).reshape(-1, 3)
    return Rays(origins, torch.cat((ahead, ahead, torch.ones(3, 3))))


def _prepare(count: int, kind: dict[str, Any], device: str) -> Callable[[str], tuple[Tensor, ...]]:
    rays = _special_rays() if kind.get("special") else _rays(count)
    count, generator = len(rays.origins), torch.Generator().manual_seed(4)
    options: dict[str, Any] = {}
    if kind.get("jitter"):
        options["jitter"] = torch.rand(count, generator=generator).to(device)
    if kind.get("window"):
        near = torch.rand(count, generator=generator)
        options["window"] = torch.stack((near, near + 0.5), dim=1).to(device)
    if kind.get("unbounded"):
        options["window"] = torch.tensor([-torch.inf, torch.inf]).expand(count, 2).to(device)
    if kind.get("resumed"):
        options["start"] = torch.randint(-1, 100, (count,), generator=generator).int().to(device)
    if "limit" in kind:
        options["limit"] = kind["limit"]
    grid, step = _grid(kind.get("grid", "dust"), device), kind.get("step", LONG)
    rays = Rays(rays.origins.to(device), rays.directions.to(device))

    def call(backend: str) -> tuple[Tensor, ...]:
        found = march(rays, grid, step, backend=backend, **options)
        return found.offsets, found.ray, found.t, found.delta, found.positions, found.resume

    return call


def _ways() -> list[Case]:
    """Every kind of ray through a full grid, an empty one, and one with a single cell."""
    some = ALL[ALL.any(dim=1)]
    middle, corner, far = torch.full((3,), 0.5), torch.zeros(3), 1e6
    kinds: dict[str, tuple[Tensor, Tensor]] = {
        "along axes": (middle - 2 * AXES, AXES),
        "along diagonals": (middle - 2 * some, some),
        "in planes of the grid": (torch.tensor([[-1.0, 0.25, 0.5]]), AXES[:1]),
        "through a corner of the cube": (corner - 2 * some, some),
        "through an edge of the cube": (torch.tensor([0.0, 0.0, 0.5]) - 2 * some, some),
        "from inside": (middle.expand(26, 3), some),
        "from a face": (torch.tensor([0.0, 0.5, 0.5]).expand(26, 3), some),
        "from a corner": (corner.expand(26, 3), some),
        "away from the cube": (middle + 2 * AXES, AXES),
        "past the cube": (middle - 2 * AXES + 3 * AXES.roll(1, dims=1), AXES),
        "without direction": (middle.expand(1, 3), torch.zeros(1, 3)),
        "from 1e6 away": (middle - far * some, some),
        "of direction 1e-30": (middle - 2 * some, 1e-30 * some),
        "of direction 1e-40": (middle - 2 * some, 1e-40 * some),
        "from inside, of direction 1e-40": (middle.expand(26, 3), 1e-40 * some),
        "of direction 1e30": (middle - 2 * some, 1e30 * some),
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
                continue  # there, rounding of t is as large as the cell
            size = rays[0].abs().max().item() + 1
            # Sampling rounds the ends of the path: by half a step in the cube, where the first
            # sample lies half a step behind the entry; by one step in the cell, over both ends.
            steps = {"full grid": 0.5, "one cell": 1.0, "empty grid": 0.0}[grid]
            rounding = 0.0 if grid == "empty grid" else 4 * math.sqrt(3) * size * U32
            way = Property(
                "march",
                holds,
                f"{steps} steps, and t rounded 4 times at the size of the origin: 4 √3 |o| u",
                {(b, "fp32"): steps * STEP + rounding for b in ("reference", "cpu")},
            )
            found.append(way.case(f"{kind}, {grid}", partial(_way_error, grid, Rays(*rays), STEP)))
    rest = Property(
        "march",
        "going on from where a ray was left gives the rest of the way",
        "half a step, and t rounded 4 times at the size of the origin: 4 √3 |o| u",
        {(b, "fp32"): FINE / 2 + 12 * math.sqrt(3) * U32 for b in ("reference", "cpu")},
    )
    diagonals = Rays(*kinds["along diagonals"])
    error = partial(_way_error, "full grid", diagonals, FINE)
    return [*found, rest.case("1024 samples reached", error)]


def _one_or_all(kind: str, device: str) -> Occupancy:
    cells = torch.full((SIZE, SIZE, SIZE), kind == "full grid")
    if kind == "one cell":
        cells[CELL] = True
    return Occupancy(cells.to(device))


def _way(kind: str, rays: Rays) -> Tensor:
    """World length of rays inside occupied cells (slab test, float64); 0 where t overflows."""
    origins, directions = rays.origins.cpu(), rays.directions.cpu()
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
    grid: str, rays: Rays, step: float, backend: str, device: str, precision: str
) -> float:
    """Error of the path length covered by the samples, found in as many calls as needed."""
    dtype = DTYPES[precision]
    rays = Rays(rays.origins.to(device, dtype), rays.directions.to(device, dtype))
    occupancy, count = _one_or_all(grid, device), len(rays.origins)
    start = torch.zeros(count, dtype=torch.int32, device=device)
    counts = torch.zeros(count, dtype=torch.int64, device=device)
    outside = 0.0
    for _ in range(math.ceil(math.sqrt(3) / step / MAX_SAMPLES) + 1):
        samples = march(rays, occupancy, step, start=start, limit=MAX_SAMPLES, backend=backend)
        counts += samples.offsets.diff()
        start = samples.resume
        if len(samples):
            outside = max(outside, (samples.positions - 0.5).abs().max().item() - 0.5)
            same = samples.ray[1:] == samples.ray[:-1]
            if (samples.t.diff()[same] < 0).any():
                return math.inf
    if (start >= 0).any():
        return math.inf
    return max((counts.cpu() * step - _way(grid, rays)).abs().max().item(), outside)

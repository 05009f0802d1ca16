"""Cases of the ray march: bit-identical samples by all backends; rays that hit faces, edges and
corners, or come from very far."""

import math
from collections.abc import Iterator
from functools import cache
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import normalize

from bench.case import U32, Bound, Case, Cases, Operation, Property, Random, placed
from bench.types import Rays
from methods.kernels.dispatch import served
from methods.kernels.march import LEAST_STEP, MAX_SAMPLES, march
from methods.kernels.types import Occupancy, Samples

STEP = math.sqrt(3) / MAX_SAMPLES
LONG = 4 * STEP  # for agreement: Triton's interpreter takes milliseconds per step
AXES = torch.cat((torch.eye(3), -torch.eye(3)))
ALL = torch.cartesian_prod(*[torch.tensor([-1.0, 0.0, 1.0])] * 3)  # [27, 3], one is 0
SOME = ALL[ALL.any(dim=1)]

SIZE = 16  # cells along the grids of the ways


def some_rays(count: int, away: float = 1.5) -> Rays:
    """Rays towards the cube from a sphere around it, every fourth from inside."""
    random = Random(count)
    outside = normalize(random.normal(count, 3), dim=-1) * away + 0.5
    inside = random.share(count, 3)
    origins = torch.where(torch.arange(count)[:, None] % 4 == 3, inside, outside)
    return Rays(origins, random.share(count, 3) - origins)


def special_rays() -> Rays:
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


def long_rays() -> Rays:
    """Rays from inside with directions up to the largest number, and lengths beyond it."""
    rays, sizes = some_rays(32), torch.tensor([1e30, 1e34, 1e35, 1e36, 1e37, 1e38, 2e38])
    origins, signs = rays.origins[3::4], rays.directions[3::4].sign()
    directions = sizes[:, None, None] * signs
    return Rays(origins.repeat(len(sizes), 1), directions.flatten(0, 1))


MIDDLE = torch.full((3,), 0.5)
OUTSIDE = MIDDLE - 2 * SOME  # of the cube, whose middle is ahead
SPECIAL = {
    "along axes": Rays(MIDDLE - 2 * AXES, AXES),
    "along diagonals": Rays(OUTSIDE, SOME),
    "in planes of the grid": Rays(torch.tensor([[-1.0, 0.25, 0.5]]), AXES[:1]),
    "through a corner of the cube": Rays(-2 * SOME, SOME),
    "through an edge of the cube": Rays(torch.tensor([0.0, 0.0, 0.5]) - 2 * SOME, SOME),
    "from inside": Rays(MIDDLE.expand(26, 3), SOME),
    "from a face": Rays(torch.tensor([0.0, 0.5, 0.5]).expand(26, 3), SOME),
    "from a corner": Rays(torch.zeros(26, 3), SOME),
    "away from the cube": Rays(MIDDLE + 2 * AXES, AXES),
    "past the cube": Rays(MIDDLE - 2 * AXES + 3 * AXES.roll(1, dims=1), AXES),
    "without direction": Rays(MIDDLE.expand(1, 3), torch.zeros(1, 3)),
    "from 1e6 away": Rays(MIDDLE - 1e6 * SOME, SOME),
    "of direction 1e-30": Rays(OUTSIDE, 1e-30 * SOME),
    "of direction 1e-40": Rays(OUTSIDE, 1e-40 * SOME),
    "from inside, of direction 1e-40": Rays(MIDDLE.expand(26, 3), 1e-40 * SOME),
    "of direction 1e30": Rays(OUTSIDE, 1e30 * SOME),
    "of directions 1 and 1e-40": Rays(
        MIDDLE + 0.01 - 2 * AXES, AXES + 1e-40 * AXES.roll(1, dims=1)
    ),
    "along an edge, off it by 1e-40": Rays(torch.zeros(6, 3), AXES.abs() + 1e-40),
    "along an edge, off it by 1e-30": Rays(torch.zeros(6, 3), AXES.abs() + 1e-30),
}

TOO_LONG = {f"of direction {size:g}": Rays(OUTSIDE, size * SOME) for size in (1e37, 3e38)}
"""3e38: all three components are finite, the length is not."""


def cells(kind: str, size: int) -> Tensor:
    """Some cells [G, G, G] of a grid of G = `size`: none, all, one at its border, a hollow sphere,
    or at random."""
    axis = (torch.arange(size) + 0.5) / size - 0.5
    radius = (axis[:, None, None] ** 2 + axis[:, None] ** 2 + axis**2).sqrt()
    drawn = Random(3).share(size, size, size)
    one = torch.zeros(size, size, size, dtype=torch.bool)
    one[size - 1, 0, size // 2] = True
    return {
        "empty": radius < 0,
        "full": radius >= 0,
        "one": one,
        "shell": (radius > 0.27) & (radius < 0.3),
        "porous shell": (radius > 0.27) & (radius < 0.4) & (drawn < 0.5),
        "dust": drawn < 0.03,
    }[kind]


def slab_lengths(rays: Rays, lower: Tensor, upper: Tensor) -> Tensor:
    """World length [R, V] of rays in boxes from `lower` to `upper` [V, 3] (slab test, float64); 0
    where t overflows in the type of the rays."""
    lower, upper = lower.double(), upper.double()
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


OUTPUTS = ("offsets", "ray", "t", "delta", "positions", "resume")


@cache
def _occupancy(kind: str, contracted: bool, device: torch.device) -> Occupancy:
    return Occupancy(cells(kind, 128 if kind == "shell" else 32).to(device), contracted)


def _march(rays: Rays, grid: str, contracted: bool = False, **how: Any) -> Samples:
    return march(rays, _occupancy(grid, contracted, rays.origins.device), **how)


EQUAL = Bound("the same operations in the same order: 0", 0.0)
MARCH = Operation("march", served(__package__), _march, dict.fromkeys(OUTPUTS, EQUAL))


def cases() -> Cases:
    """Every kind of ray, grid, window, phase and limit."""
    return [*_agreements(), *_ways()]


def _agreements() -> Cases:
    """Rays from inside and outside through a grid of scattered cells; with windows and limits."""
    random = Random(4)
    near = random.share(129)
    everywhere = torch.tensor([-torch.inf, torch.inf]).expand(129, 2)
    start = random.whole(-1, 100, 129).int()
    kinds: dict[str, tuple[Rays, str, dict[str, Any]]] = {
        "no ray": (some_rays(0), "dust", {}),
        "one ray": (some_rays(1), "dust", {}),
        "inside and outside": (some_rays(129), "dust", {}),
        "jitter": (some_rays(129), "dust", {"jitter": random.share(129)}),
        "window": (some_rays(129), "dust", {"window": torch.stack((near, near + 0.5), dim=1)}),
        "window without bounds": (some_rays(129), "dust", {"window": everywhere}),
        "resumed": (some_rays(129), "dust", {"start": start}),
        "limit 1": (some_rays(129), "dust", {"limit": 1}),
        "limit 7": (some_rays(129), "dust", {"limit": 7}),
        "empty grid": (some_rays(65), "empty", {}),
        "full grid": (some_rays(65), "full", {}),
        "one cell": (some_rays(65), "one", {}),
        "axes, planes, corners and what is not finite": (special_rays(), "dust", {}),
        "long directions": (long_rays(), "porous shell", {}),
    }
    found = []
    for name, (rays, grid, options) in kinds.items():
        found += MARCH.cases(name, dict, {"rays": rays, "grid": grid, "step": LONG, **options})
    endless = {"step": LONG, "contracted": True}
    for name in ("inside and outside", "jitter", "window", "resumed", "limit 7"):
        options = {key: x[:33] if key != "limit" else x for key, x in kinds[name][2].items()}
        given = {"rays": some_rays(33), "grid": "dust", **endless, **options}
        found += MARCH.cases(f"all of space, {name}", dict, given)
    for name in ("axes, planes, corners and what is not finite", "long directions"):
        given = {"rays": kinds[name][0], "grid": "porous shell", **endless}
        found += MARCH.cases(f"all of space, {name}", dict, given)
    many = {"rays": some_rays(1 << 13), "grid": "shell", "step": STEP}
    return [*found, *MARCH.cases("hollow sphere", dict, many, items=1 << 13)]


def _ways() -> Iterator[Case]:
    """Every kind of ray through a full grid, an empty one, and one with a single cell."""
    # Sampling rounds the ends of the path: by half a step in the cube, where the first sample lies
    # half a step behind the entry; by one step in the cell, over both ends.
    for grid, holds, steps in (
        ("full", "samples add up to the way through the cube, and lie on it", 0.5),
        ("one", "samples add up to the way through the cell, and lie on it", 1.0),
        ("empty", "no samples", 0.0),
    ):
        for kind, rays in (SPECIAL | TOO_LONG).items():
            if "1e6" in kind and grid == "one":
                continue  # there, rounding of t is as large as the cell
            size = rays.origins.abs().max().item() + 1
            rounding = 0.0 if grid == "empty" else 4 * math.sqrt(3) * size * U32
            way = Property(
                "march",
                holds,
                f"{steps} steps, and t rounded 4 times at the size of the origin: 4 √3 |o| u",
                {(b, "fp32"): steps * STEP + rounding for b in ("reference", "cpu")},
            )
            yield way.case(f"{kind}, {grid}", _way_error, grid, rays)


def _way_error(grid: str, given: Rays, backend: str, device: str, precision: str) -> float:
    """Error of the path length covered by the samples; infinite if they are not in order."""
    rays = placed(given, device, precision)
    occupied = cells(grid, SIZE)
    samples = march(rays, Occupancy(occupied.to(device)), STEP, backend=backend)
    same = samples.ray[1:] == samples.ray[:-1]
    if (samples.t.diff()[same] < 0).any() or (samples.resume >= 0).any():
        return math.inf
    lower = occupied.nonzero() / SIZE
    step_t = STEP / rays.directions.cpu().double().norm(dim=1)
    way = slab_lengths(rays, lower, lower + 1 / SIZE).sum(dim=1) * (step_t >= LEAST_STEP)
    wrong = (samples.offsets.diff().cpu() * STEP - way).abs().max().item()
    outside = (samples.positions - 0.5).abs().max().item() - 0.5 if len(samples) else 0.0
    return max(wrong, outside)

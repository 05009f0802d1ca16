"""Cases of the voxel walk: bit-identical crossings by all backends; lengths against a slab test per
voxel; rays that hit faces, edges and corners, or come from far; pixels, also in closed form."""

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
from methods.kernels.march.cases import ALL, AXES
from methods.kernels.voxel_walk import Light, Voxels, render_voxels, walk

SIZE = 24
"""Resolution of the grids in most cases; not a power of two, so that planes are rounded."""

LONGEST = 3 * SIZE
"""Maximum number of voxels on a ray in these grids."""

COLOUR = (16 * 50 * 6 + 16 * 16 * 6) / 4 + 8
"""Error bound in u of a colour: a quarter (slope of the sigmoid) of the error of a sum of 16
products of harmonics (below 2, error 48 u) and numbers below 6, plus the sigmoid's own error."""


def cases() -> list[Case]:
    """Every kind of grid, ray, start and limit."""
    return [*_agreements(), *_lengths(), *_pixels(), *_cubes()]


def _agreements() -> list[Case]:
    kinds: list[tuple[str, int, dict[str, Any]]] = [
        ("limit 1", 129, {"limit": 1, "grid": "full"}),
        ("no ray", 0, {}),
        ("one ray", 1, {}),
        ("inside and outside", 129, {}),
        ("more rays than are walked together", 5000, {"grid": "one"}),
        ("no voxel", 65, {"grid": "empty"}),
        ("all voxels", 65, {"grid": "full"}),
        ("one voxel", 65, {"grid": "one"}),
        ("limit 7", 129, {"limit": 7, "grid": "full"}),
        ("begun on the way", 129, {"start": True, "grid": "full"}),
        ("axes, planes, corners and what is not finite", 0, {"special": True, "grid": "full"}),
        ("from 1e6 away", 129, {"away": 1e6, "grid": "full"}),
    ]
    kernel = Agreement(
        "voxel_walk",
        served(__package__),
        "t of planes by the same operations, cells by comparing them: 0",
    )
    found = [kernel.case(name, partial(_prepare, rays, kind), 0.0) for name, rays, kind in kinds]
    timed = partial(_prepare, 1 << 13, {"grid": "shell"})
    return [*found, kernel.case("hollow sphere in 128^3", timed, 0.0, items=1 << 13)]


def _grid(kind: str, device: str) -> Voxels:
    size = 128 if kind == "shell" else SIZE
    axis = (torch.arange(size) + 0.5) / size - 0.5
    cells = torch.cartesian_prod(*[torch.arange(size)] * 3)
    radius = torch.cartesian_prod(axis, axis, axis).norm(dim=1)
    generator = torch.Generator().manual_seed(3)
    kept = {
        "empty": radius < 0,
        "full": radius >= 0,
        "one": (cells == torch.tensor([size - 1, 0, size // 2])).all(dim=1),
        "shell": (radius > 0.27) & (radius < 0.3),
        "dust": torch.rand(len(cells), generator=generator) < 0.05,
    }[kind]
    chosen = cells[kept]
    mixed = chosen[torch.randperm(len(chosen), generator=generator)]
    return Voxels(mixed.to(device), size)


def _rays(count: int, away: float) -> Rays:
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


def _prepare(count: int, kind: dict[str, Any], device: str) -> Callable[[str], tuple[Tensor, ...]]:
    rays = _special_rays() if kind.get("special") else _rays(count, kind.get("away", 1.5))
    count, generator = len(rays.origins), torch.Generator().manual_seed(4)
    options: dict[str, Any] = {}
    if kind.get("start"):
        start = 2 * torch.rand(count, generator=generator) - 0.2
        start[:4] = torch.tensor([torch.inf, -torch.inf, torch.nan, 1e30])
        options["start"] = start.to(device)
    if "limit" in kind:
        options["limit"] = kind["limit"]
    voxels = _grid(kind.get("grid", "dust"), device)
    rays = Rays(rays.origins.to(device), rays.directions.to(device))

    def call(backend: str) -> tuple[Tensor, ...]:
        found = walk(rays, voxels, backend=backend, **options)
        # Infinity minus infinity would be no number: where a ray has no more, -1.
        resume = torch.where(found.resume.isinf(), -1, found.resume)
        return (
            found.offsets,
            found.ray,
            found.voxel,
            found.near,
            found.far,
            found.t,
            found.delta,
            resume,
        )

    return call


def _lengths() -> list[Case]:
    """Every kind of ray through full, scattered, empty and one-voxel grids; also in rounds."""
    some = ALL[ALL.any(dim=1)]
    middle, corner = torch.full((3,), 0.5), torch.zeros(3)
    kinds: dict[str, tuple[Tensor, Tensor]] = {
        "from all around": (_rays(60, 1.5).origins, _rays(60, 1.5).directions),
        "along axes": (middle + 0.01 - 2 * AXES, AXES),
        "along diagonals": (middle - 2 * some, some),
        "through a corner of the cube": (corner - 2 * some, some),
        "from inside": (middle.expand(26, 3) + 0.01, some),
        "from a face": (torch.tensor([0.0, 0.49, 0.51]).expand(26, 3), some),
        "past the cube": (middle - 2 * AXES + 3 * AXES.roll(1, dims=1), AXES),
        "without direction": (middle.expand(1, 3), torch.zeros(1, 3)),
        "of direction 1e-30": (middle + 0.01 - 2 * some, 1e-30 * some),
        "of direction 1e-40": (middle - 2 * some, 1e-40 * some),
        "of direction 1e30": (middle + 0.01 - 2 * some, 1e30 * some),
        "of directions 1 and 1e-40": (
            middle + 0.01 - 2 * AXES,
            AXES + 1e-40 * AXES.roll(1, dims=1),
        ),
    }
    found = []
    for grid in ("full", "dust", "one", "empty"):
        for kind, rays in kinds.items():
            size = rays[0].abs().max().item() + 1
            each = Property(
                "voxel_walk",
                "the length in each voxel is that of its own slab test",
                "entry and exit of a voxel each rounded 4 times at the size of the origin, by a "
                "direction at most √3 as long as its largest component, and where edges and "
                "corners are cut as often again: 16 √3 |o| u",
                {(b, "fp32"): 16 * math.sqrt(3) * size * U32 for b in ("reference", "cpu")},
            )
            for limit in (None, 3) if kind == "from all around" else (None,):
                name = f"{kind}, {grid}" + (f", {limit} at a time" if limit else "")
                found.append(each.case(name, partial(_length_error, grid, Rays(*rays), limit)))
    touching = Property(
        "voxel_walk",
        "voxels that touch share their t, and no voxel is crossed twice",
        "one number, computed once: 0",
        {(b, "fp32"): 0.0 for b in ("reference", "cpu")},
    )
    return found + [
        touching.case(f"{kind}, all touch", partial(_gaps, Rays(*kinds[kind])))
        for kind in ("from all around", "along diagonals", "from inside")
    ]


def _length_error(
    grid: str, given: Rays, limit: int | None, backend: str, device: str, precision: str
) -> float:
    """Largest error of a ray's length in a voxel, walked in rounds of `limit`.

    Infinite if crossings are not in order.
    """
    dtype = DTYPES[precision]
    rays = Rays(given.origins.to(device, dtype), given.directions.to(device, dtype))
    voxels, count = _grid(grid, device), len(given.origins)
    lengths = torch.zeros(count, len(voxels) + 1, dtype=torch.float64)
    start = torch.zeros(count, dtype=dtype, device=device)
    for _ in range(3 * SIZE if limit else 1):
        found = walk(rays, voxels, start=start, limit=limit, backend=backend)
        lengths.index_put_(
            (found.ray.long().cpu(), found.voxel.long().cpu()), found.delta.double().cpu(), True
        )
        start = found.resume
        same = found.ray[1:] == found.ray[:-1]
        if (found.near[1:] < found.far[:-1])[same].any() or (found.delta <= 0).any():
            return math.inf
    if (start != torch.inf).any():
        return math.inf
    return (
        (lengths[:, :-1] - _exact_lengths(rays, voxels)).abs().amax().item() if len(voxels) else 0.0
    )


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


def _gaps(rays: Rays, backend: str, device: str, precision: str) -> float:
    """Largest gap between crossings of a full grid; infinite if a voxel is crossed twice."""
    dtype = DTYPES[precision]
    rays = Rays(rays.origins.to(device, dtype), rays.directions.to(device, dtype))
    found = walk(rays, _grid("full", device), backend=backend)
    pairs = torch.stack((found.ray, found.voxel), dim=1)
    if not len(found) or len(pairs.unique(dim=0)) < len(pairs):
        return math.inf
    same = found.ray[1:] == found.ray[:-1]
    return (found.near[1:] - found.far[:-1])[same].abs().amax().item()


def _scene(size: int, kind: str, device: str) -> tuple[Voxels, Light]:
    """Voxels in a thick shell, every second one, of random density and light."""
    generator = torch.Generator().manual_seed(size)
    axis = (torch.arange(size) + 0.5) / size - 0.5
    cells = torch.cartesian_prod(*[torch.arange(size)] * 3)
    radius = torch.cartesian_prod(axis, axis, axis).norm(dim=1)
    kept = (radius > 0.27) & (radius < 0.4) & (torch.rand(len(cells), generator=generator) < 0.5)
    if kind == "nothing":
        kept[:] = False
    coordinates = cells[kept]
    scale = {"clear": 0.0, "mist": 2.0, "stone": 1e4}.get(kind, 20.0)
    density = scale * torch.rand(len(coordinates), generator=generator)
    harmonics = torch.randn(len(coordinates), 9, 3, generator=generator).clamp(-6, 6)
    return Voxels(coordinates.to(device), size), Light(density.to(device), harmonics.to(device))


def _views(count: int, device: str) -> Rays:
    generator = torch.Generator().manual_seed(count)
    origins = normalize(torch.randn(count, 3, generator=generator), dim=1) * 1.5 + 0.5
    targets = torch.rand(count, 3, generator=generator)
    return Rays(origins.to(device), (targets - origins).to(device))


def _pixels() -> list[Case]:
    kernel = Agreement(
        "render_voxels",
        served(__package__),
        "colours as `COLOUR` says; light rounded once or twice a voxel by u, at most 72 voxels, "
        "and depths up to 3; where a weight next to `stop` or `faint` counts on one side only: 3 "
        "(stop + 72 faint)",
    )
    rounding = (COLOUR + 3 * 4 * LONGEST) * U32
    found = []
    for name, rays, kind, stop, faint in (
        ("one ray", 1, "cloud", 0.0, 0.0),
        ("no ray", 0, "cloud", 0.0, 0.0),
        ("cloud", 129, "cloud", 0.0, 0.0),
        ("mist", 129, "mist", 0.0, 0.0),
        ("stone", 129, "stone", 0.0, 0.0),
        ("voxels without density", 129, "clear", 0.0, 0.0),
        ("no voxel", 129, "nothing", 0.0, 0.0),
        ("stop and faint", 129, "cloud", 1e-4, 1e-5),
    ):
        found.append(
            kernel.case(
                name,
                partial(_rendered, 24, rays, kind, stop, faint),
                rounding + 3 * (stop + LONGEST * faint),
            )
        )
    # 128^3 voxels: at most 384 on a ray.
    large = (COLOUR + 3 * 4 * 384) * U32 + 3 * (1e-4 + 384 * 1e-5)
    timed = partial(_rendered, 128, 1 << 13, "cloud", 1e-4, 1e-5)
    return [*found, kernel.case("a frame of 128^3", timed, large, items=1 << 13)]


def _rendered(
    size: int, count: int, kind: str, stop: float, faint: float, device: str
) -> Callable[[str], tuple[Tensor, ...]]:
    voxels, light = _scene(size, kind, device)
    rays = _views(count, device)

    def call(backend: str) -> tuple[Tensor, ...]:
        pixels, _, _ = render_voxels(rays, voxels, light, stop=stop, faint=faint, backend=backend)
        return pixels.values, pixels.depth_sum, pixels.alpha

    return call


def _cubes() -> list[Case]:
    """A cube of equal voxels, whose pixels are known."""
    known = Property(
        "render_voxels",
        "opacity is 1 - exp(-sigma chord), and colour is that opacity times that of the direction",
        "a chord of at most 36 pieces, each off by 16 √3 (|o| + 1) u, at |o| of 2 and a density of "
        "10, and what compositing rounds",
        {
            (b, "fp32"): (10 * 36 * 16 * 3 * math.sqrt(3) + COLOUR) * U32
            for b in ("reference", "cpu")
        },
    )
    return [known.case("a cube of 12^3 voxels", _cube_error)]


def _cube_error(backend: str, device: str, precision: str) -> float:
    dtype = DTYPES[precision]
    rays = _views(200, device)
    rays = Rays(rays.origins.to(dtype), rays.directions.to(dtype))
    cells = torch.cartesian_prod(*[torch.arange(6, 18, device=device)] * 3)
    # C of Y_1,-1 = sqrt(3 / 4 pi) y: the logit of red is the direction's y, of green 1.
    harmonics = torch.zeros(len(cells), 4, 3, dtype=dtype, device=device)
    harmonics[:, 1, 0] = math.sqrt(4 * math.pi / 3)
    harmonics[:, 0, 1] = math.sqrt(4 * math.pi)
    density = torch.full((len(cells),), 10.0, dtype=dtype, device=device)
    light = Light(density, harmonics)
    pixels, _, _ = render_voxels(rays, Voxels(cells, 24), light, stop=0.0, backend=backend)
    o, d = rays.origins.double(), rays.directions.double()
    ends = torch.stack(((0.25 - o) / d, (0.75 - o) / d))
    chord = (ends.amax(0).amin(1) - ends.amin(0).amax(1).clamp(min=0)).clamp(min=0)
    opacity = -torch.expm1(-10 * chord * d.norm(dim=1))
    red = (d[:, 1] / d.norm(dim=1)).sigmoid()
    green, blue = torch.full_like(red, 1.0).sigmoid(), torch.full_like(red, 0.5)
    want = opacity[:, None] * torch.stack((red, green, blue), dim=1)
    colours = (pixels.values.double() - want).abs().max()
    return max(colours.item(), (pixels.alpha.double() - opacity).abs().max().item())

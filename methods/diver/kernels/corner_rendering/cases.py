"""Cases of the pixels of corner features: agreement of the backends, a closed form, NaN."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor
from torch.nn.functional import normalize

from bench.case import DTYPES, U32, Agreement, Case, Property, on_backends
from bench.types import Rays
from methods.diver.kernels.corner_rendering import Corners, Layers, render_segments
from methods.kernels.corner_gather import CORNERS
from methods.kernels.dispatch import served
from methods.kernels.voxel_walk import Voxels, walk

FEATURES = HIDDEN = 32
SIDE = 16
"""Voxels along the grid of the small cases."""

DENSEST = 1 / 4
"""Largest density of a segment: sums of 32 products of at most 1 / 128."""

SUMS = (
    "weights of the corners are off by 32 u, their sum of 8 by 144 u: 400 u; a layer whose "
    "absolute weights add up to 1 keeps that and adds 34 u; the density has a quarter of it, and "
    "the opacity of n segments is off by all of them; colours by 540 / 4 u; light is rounded once "
    "or twice a segment, and depths are at most 3; where a weight beside `stop` or `faint` counts "
    "on one side only: 3 (stop + n faint)"
)


def cases() -> list[Case]:
    """Few and many rays, both types of tables, rays that end early, NaN."""
    return [*_agreements(), *_even_media(), *_spoilt()]


def _agreements() -> list[Case]:
    kernel = Agreement("corner_rendering", served(__package__), SUMS)
    found = []
    for name, count, dtype, stop, faint in (
        ("no ray", 0, torch.float32, 0.0, 0.0),
        ("one ray", 1, torch.float32, 0.0, 0.0),
        ("129 rays", 129, torch.float32, 0.0, 0.0),
        ("129 rays, table of bfloat16", 129, torch.bfloat16, 0.0, 0.0),
        ("129 rays, stop and faint", 129, torch.float32, 1e-4, 1e-5),
    ):
        call = partial(_rendered, SIDE, count, dtype, stop, faint)
        found.append(kernel.case(name, call, _tolerance(3 * SIDE, stop, faint)))
    timed = partial(_rendered, 64, 1 << 13, torch.bfloat16, 1e-2, 1e-2)
    tolerance = _tolerance(3 * 64, 1e-2, 0) + 3 * 2e-2  # few weights lie beside `faint`
    return [*found, kernel.case("8,192 rays in 64^3", timed, tolerance, items=1 << 13)]


def _tolerance(longest: int, stop: float, faint: float) -> float:
    light = longest * 468 * DENSEST + 4 * longest
    return 3 * ((light + 540 / 4) * U32 + stop + longest * faint)


def some_scene(side: int, dtype: torch.dtype, device: str) -> tuple[Voxels, Corners, Layers]:
    """Every third voxel of a grid, with features from -1 to 1."""
    generator = torch.Generator().manual_seed(side)

    def between(low: float, high: float, *shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator) * (high - low) + low

    cells = torch.cartesian_prod(*[torch.arange(side)] * 3)
    cells = cells[torch.rand(len(cells), generator=generator) < 1 / 3].int()
    bits = torch.arange(CORNERS)[:, None] >> torch.arange(3) & 1
    vertices = cells[:, None] + bits  # [V, 8, 3]
    rows = (vertices * torch.tensor([(side + 1) ** 2, side + 1, 1])).sum(dim=2).int()
    table = between(-1, 1, (side + 1) ** 3, FEATURES).to(dtype)
    layers = (
        between(-1, 1, HIDDEN, FEATURES) / FEATURES,
        between(0, 1, HIDDEN),
        between(0, DENSEST, 1, HIDDEN) / HIDDEN,
        between(0, 0.01, 1),
        between(-1, 1, HIDDEN, HIDDEN) / HIDDEN,
        between(-1, 1, 3, HIDDEN) / HIDDEN,
        between(-1, 1, 3),
    )
    corners = Corners(rows.to(device), table.to(device))
    return Voxels(cells.to(device), side), corners, Layers(*(x.to(device) for x in layers))


def some_rays(count: int, device: str) -> Rays:
    """From all around into the cube."""
    generator = torch.Generator().manual_seed(count)
    origins = normalize(torch.randn(count, 3, generator=generator), dim=1) * 1.5 + 0.5
    targets = torch.rand(count, 3, generator=generator)
    return Rays(origins.to(device), (targets - origins).to(device))


def some_towards(count: int, device: str) -> Tensor:
    """What the directions of so many rays add."""
    generator = torch.Generator().manual_seed(count)
    return (torch.rand(count, HIDDEN, generator=generator) - 0.5).to(device)


def _rendered(
    side: int, count: int, dtype: torch.dtype, stop: float, faint: float, device: str
) -> Callable[[str], tuple[Tensor, ...]]:
    voxels, corners, layers = some_scene(side, dtype, device)
    rays, towards = some_rays(count, device), some_towards(count, device)

    def call(backend: str) -> tuple[Tensor, ...]:
        pixels, _, _ = render_segments(
            rays, voxels, corners, layers, towards, stop=stop, faint=faint, backend=backend
        )
        return pixels.values, pixels.depth_sum, pixels.alpha

    return call


def _even_media() -> list[Case]:
    """All corners are alike, so that a ray through n voxels has a known pixel."""
    known = Property(
        "corner_rendering",
        "opacity is 1 - exp(-n sigma), and colour is that opacity times that of the direction",
        "of n segments the density is off by 34 u of a quarter each; what compositing rounds",
        {
            (b, "fp32"): (3 * SIDE * 34 * DENSEST + 540 / 4 + 4 * 3 * SIDE) * U32
            for b in ("reference", "cpu")
        },
    )
    return [known.case("all corners alike", _even_error)]


def _even_error(backend: str, device: str, precision: str) -> float:
    dtype = DTYPES[precision]
    voxels, corners, layers = some_scene(SIDE, dtype, device)
    features = corners.table[:1]
    corners = Corners(corners.rows, features.repeat(len(corners.table), 1))
    rays, towards = some_rays(129, device), some_towards(129, device)
    pixels, crossed, _ = render_segments(
        rays, voxels, corners, layers, towards, stop=0.0, backend=backend
    )
    wide = [getattr(layers, name).double() for name in vars(layers)]
    hidden_w, hidden_b, density_w, density_b, geometry, colour_w, colour_b = wide
    hidden = (features.double().relu() @ hidden_w.T + hidden_b).relu()
    sigma = (hidden @ density_w.T + density_b).relu()[0, 0]
    count = walk(rays, voxels, backend="reference").offsets.diff()
    opacity = -torch.expm1(-sigma * count)
    shown = (hidden @ geometry.T + towards.double()).relu()
    colours = opacity[:, None] * (shown @ colour_w.T + colour_b).sigmoid()
    if not torch.equal(crossed.long(), count):
        return math.inf
    errors = (pixels.values - colours).abs().max(), (pixels.alpha - opacity).abs().max()
    return max(error.item() for error in errors)


def _spoilt() -> list[Case]:
    kept = Property(
        "corner_rendering",
        "a NaN among the features spoils the rays through its voxels alone",
        "exact",
        on_backends(0, backends=served(__package__)),
    )
    return [kept.case("NaN in one corner", _spoilt_error)]


def _spoilt_error(backend: str, device: str, precision: str) -> float:
    """0 if it holds, else infinity."""
    voxels, corners, layers = some_scene(SIDE, DTYPES[precision], device)
    rays, towards = some_rays(129, device), some_towards(129, device)
    spoilt = Corners(corners.rows, corners.table.clone())
    row = corners.rows[len(voxels) // 2, 0]
    spoilt.table[row] = math.nan
    whole, other = (
        render_segments(rays, voxels, c, layers, towards, stop=0.0, backend=backend)[0]
        for c in (corners, spoilt)
    )
    crossings = walk(rays, voxels, backend="reference")
    touched = torch.zeros(len(rays.origins), dtype=torch.bool, device=device)
    at_corner = (corners.rows == row).any(dim=1)
    touched[crossings.ray[at_corner[crossings.voxel.long()]].long()] = True
    spoils = other.values.isnan().all(dim=1)
    same = torch.equal(other.values[~touched], whole.values[~touched])
    return 0.0 if same and torch.equal(spoils, touched) and touched.any() else math.inf

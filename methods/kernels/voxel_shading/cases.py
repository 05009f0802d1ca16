"""Cases of shaded voxels: colours and their gradients, pixels, and a cube in closed form."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor
from torch.nn.functional import normalize

from bench.case import DTYPES, U32, Agreement, Case, Property
from bench.types import Rays
from methods.kernels.dispatch import served
from methods.kernels.voxel_shading import Light, render_voxels, shade_voxels
from methods.kernels.voxel_walk import Voxels

SUMS = 16 * 50 * 6 + 16 * 16 * 6
"""Roundings of a sum of 16 products of harmonics below 2, off by 48 u, with numbers below 6."""

LONGEST = 3 * 24
"""Most voxels of a ray in the small grids."""


def cases() -> list[Case]:
    """No, one and many voxels; all degrees; all stops; forward and backward."""
    return [*_colours(), *_pixels(), *_cubes()]


def _colours() -> list[Case]:
    forward = Agreement(
        "shade_voxels",
        served("voxel_shading"),
        "the sum of `shade`, of which the sigmoid passes on a quarter, and 8 u of its own",
    )
    backward = Agreement(
        "shade_voxels backward",
        served("voxel_shading"),
        "harmonics below 2, off by 48 u, times slopes below 6 / 4, off by as much as colours are "
        "and 4 u, summed over at most 40 visits of a voxel",
    )
    found = []
    for count in (0, 1, 300, 1 << 16):
        for size in (1, 4, 9, 16) if count == 300 else (9,):
            name, items = f"{count:,} of {size} harmonics", count if count > 300 else None
            found += [
                forward.case(
                    name, partial(_shaded, count, size), (SUMS / 4 + 8) * U32, items=items
                ),
                backward.case(
                    name,
                    partial(_gradients, count, size),
                    40 * 6 * (2 * (SUMS / 4 + 12) + 48 + 40) * U32,
                    items=items,
                ),
            ]
    found.append(
        backward.case(
            "added to a buffer",
            partial(_gradients, 300, 9, buffered=True),
            40 * 6 * (2 * (SUMS / 4 + 12) + 48 + 40) * U32,
        )
    )
    return found


def _given(count: int, size: int, device: str) -> tuple[Tensor, ...]:
    """Harmonics, voxels, rays, directions and the gradient of the colours; all below 6."""
    generator = torch.Generator().manual_seed(count)
    voxels, rays = count // 3 + 1, count // 5 + 1
    harmonics = torch.randn(voxels, size, 3, generator=generator).clamp(-6, 6)
    voxel = torch.randint(voxels, (count,), generator=generator).int()
    ray = torch.randint(rays, (count,), generator=generator).sort().values.int()
    directions = normalize(torch.randn(rays, 3, generator=generator), dim=1)
    grad = torch.randn(count, 3, generator=generator).clamp(-6, 6)
    return tuple(x.to(device) for x in (harmonics, voxel, ray, directions, grad))


def _shaded(count: int, size: int, device: str) -> Callable[[str], tuple[Tensor, ...]]:
    *given, _ = _given(count, size, device)
    return lambda backend: (shade_voxels(*given, backend=backend),)


def _gradients(
    count: int, size: int, device: str, buffered: bool = False
) -> Callable[[str], tuple[Tensor, ...]]:
    harmonics, *given, grad = _given(count, size, device)

    def call(backend: str) -> tuple[Tensor, ...]:
        learned = harmonics.clone().requires_grad_()
        buffer = torch.ones_like(harmonics) if buffered else None
        colours = shade_voxels(learned, *given, grad_buffer=buffer, backend=backend)
        colours.backward(grad)
        gradient = learned.grad if buffer is None else buffer - 1
        assert gradient is not None
        return (gradient,)

    return call


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


def _rays(count: int, device: str) -> Rays:
    generator = torch.Generator().manual_seed(count)
    origins = normalize(torch.randn(count, 3, generator=generator), dim=1) * 1.5 + 0.5
    targets = torch.rand(count, 3, generator=generator)
    return Rays(origins.to(device), (targets - origins).to(device))


def _pixels() -> list[Case]:
    kernel = Agreement(
        "render_voxels",
        served("voxel_shading"),
        "colours as above; light rounded once or twice a voxel by u, at most 72 voxels, and depths "
        "up to 3; where a weight next to `stop` or `faint` counts on one side only: 3 (stop + "
        "72 faint)",
    )
    rounding = (SUMS / 4 + 8 + 3 * 4 * LONGEST) * U32
    found = []
    for name, rays, kind, stop, faint in (
        ("no ray", 0, "cloud", 0.0, 0.0),
        ("one ray", 1, "cloud", 0.0, 0.0),
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
    # Of 128^3: 384 voxels at most.
    large = (SUMS / 4 + 8 + 3 * 4 * 384) * U32 + 3 * (1e-4 + 384 * 1e-5)
    timed = partial(_rendered, 128, 1 << 13, "cloud", 1e-4, 1e-5)
    return [*found, kernel.case("a frame of 128^3", timed, large, items=1 << 13)]


def _rendered(
    size: int, count: int, kind: str, stop: float, faint: float, device: str
) -> Callable[[str], tuple[Tensor, ...]]:
    voxels, light = _scene(size, kind, device)
    rays = _rays(count, device)

    def call(backend: str) -> tuple[Tensor, ...]:
        pixels, _, _ = render_voxels(rays, voxels, light, stop=stop, faint=faint, backend=backend)
        return pixels.values, pixels.depth_sum, pixels.alpha

    return call


def _cubes() -> list[Case]:
    """A cube of voxels all alike, whose pixels are known."""
    known = Property(
        "render_voxels",
        "opacity is 1 - exp(-sigma chord), and colour is that opacity times that of the direction",
        "a chord of at most 36 pieces, each off by 16 √3 (|o| + 1) u, at |o| of 2 and a density of "
        "10, and what compositing rounds",
        {(b, "fp32"): (10 * 36 * 16 * 3 * math.sqrt(3) + SUMS) * U32 for b in ("reference", "cpu")},
    )
    return [known.case("a cube of 12^3 voxels", _cube_error)]


def _cube_error(backend: str, device: str, precision: str) -> float:
    dtype = DTYPES[precision]
    rays = _rays(200, device)
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

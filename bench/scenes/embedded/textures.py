"""Procedural textures: from points in a part's own frame to colours, [N, 3] -> [N, 3] in [0, 1]."""

import math
from collections.abc import Callable
from functools import cache, partial

import torch
from torch import Tensor
from torch.nn.functional import grid_sample, pad

Colour = tuple[float, float, float]
Texture = Callable[[Tensor], Tensor]


def texture(paint: Callable[..., Tensor]) -> Callable[..., Texture]:
    """Turn a function of settings and points into one that takes settings and returns a texture."""
    return partial(partial, paint)


@texture
def plain(colour: Colour, points: Tensor) -> Tensor:
    return points.new_tensor(colour).expand(len(points), 3)


@texture
def checker(first: Colour, second: Colour, size: float, points: Tensor) -> Tensor:
    """Cubes of side `size`, alternating."""
    # The shift keeps faces at round coordinates away from the border between two cubes.
    return pick(((points / size + 0.137).floor().sum(1) % 2) < 1, first, second)


@texture
def polar_checker(first: Colour, second: Colour, count: int, ring: float, points: Tensor) -> Tensor:
    """`count` sectors around z and rings (or levels) of width `ring`, alternating."""
    x, y, z = points.unbind(1)
    sector = (torch.atan2(y, x) * count / (2 * math.pi)).floor()
    level = ((x * x + y * y).sqrt() / ring + 0.29).floor() + (z / ring + 0.29).floor()
    return pick((sector + level) % 2 < 1, first, second)


@texture
def spiral(first: Colour, second: Colour, stripes: int, twist: float, points: Tensor) -> Tensor:
    """Stripes around z that turn `twist` radians per unit of height."""
    x, y, z = points.unbind(1)
    phase = (torch.atan2(y, x) + twist * z) * stripes / (2 * math.pi)
    return pick(phase % 1 < 0.5, first, second)


@texture
def chevrons(first: Colour, second: Colour, period: float, slope: float, points: Tensor) -> Tensor:
    """Zigzag stripes along x that repeat every `period`."""
    x, _, z = points.unbind(1)
    phase = x / period + slope * (z / period % 1 - 0.5).abs()
    return pick(phase % 1 < 0.5, first, second)


@texture
def pips(ground: Colour, dot: Colour, spacing: float, radius: float, points: Tensor) -> Tensor:
    """Dots on a lattice, round on the faces of a box."""
    cell = (points / spacing).round() * spacing
    return pick((points - cell).norm(dim=1) < radius, dot, ground)


@texture
def eye(iris: Colour, points: Tensor) -> Tensor:
    """White, with an iris and a pupil that look along -y."""
    facing = -points[:, 1] / points.norm(dim=1)
    inner = pick(facing > math.cos(0.32), (0.02, 0.02, 0.03), iris)
    white = points.new_tensor((0.97, 0.96, 0.93))
    return torch.where((facing > math.cos(0.62))[:, None], inner, white)


@texture
def marble(ground: Colour, vein: Colour, scale: float, points: Tensor) -> Tensor:
    """Veins: a sine along x, distorted by noise."""
    bend = noise(points * scale) + 0.5 * noise(points * (2.1 * scale))
    wave = torch.sin((points[:, 0] + 0.6 * points[:, 2]) * 2 * scale + 5 * bend).abs()
    return mix(wave.clamp(max=0.55) / 0.55, vein, ground)


@texture
def wood(light: Colour, dark: Colour, rings: float, points: Tensor) -> Tensor:
    """Growth rings around an axis along x outside the part, distorted by noise."""
    _, y, z = points.unbind(1)
    radius = torch.hypot(y + 0.7, 2 * z + 0.4) + 0.08 * noise(points * 3)
    phase = radius * rings
    return mix((phase % 1) ** 2, light, dark)


@texture
def mottled(first: Colour, second: Colour, scale: float, points: Tensor) -> Tensor:
    """Two octaves of noise that blend two colours."""
    share = 0.65 * noise(points * scale) + 0.35 * noise(points * (4.3 * scale))
    return mix(share, first, second)


def noise(points: Tensor) -> Tensor:
    """[N] in [0, 1]: random values at integer coordinates, smooth in between, with period 32."""
    table = lattice().to(points.dtype)
    cell = points.floor()
    part = points - cell
    # Trilinear at smoothstep coordinates, which avoids creases at the borders of cells.
    place = (cell + part * part * (3 - 2 * part)) / (table.shape[-1] - 1)
    place = (place % 1) * 2 - 1  # [-1, 1] spans the table from first to last vertex
    return grid_sample(table[None, None], place[None, None, None], align_corners=True).reshape(-1)


@cache
def lattice() -> Tensor:
    """[33, 33, 33] random values; the last planes repeat the first ones."""
    values = torch.rand(32, 32, 32, generator=torch.Generator().manual_seed(1))
    return pad(values[None, None], (0, 1) * 3, mode="circular")[0, 0]


def pick(condition: Tensor, first: Colour, second: Colour) -> Tensor:
    """`first` where `condition` [N], else `second`: [N, 3]."""
    return torch.tensor((second, first))[condition.long()]


def mix(share: Tensor, first: Colour, second: Colour) -> Tensor:
    """Blend from `first` at share 0 to `second` at share 1: [N, 3]."""
    start, end = share.new_tensor(first), share.new_tensor(second)
    return start + share[:, None] * (end - start)

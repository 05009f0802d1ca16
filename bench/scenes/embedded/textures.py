"""Procedural textures: from points in a part's own frame to colours, [N, 3] -> [N, 3] in [0, 1].

Those of buildings, from `bricks` on, are small pieces, each with a tone of its own, stained and
worn. They repeat along x + y and z, so that a wall that faces x or y shows the same pattern, also
around a corner. A wall made of several parts takes `placed`, and its pattern goes on in each.
"""

import math
from collections.abc import Callable
from functools import cache, partial

import torch
from torch import Tensor
from torch.nn.functional import grid_sample, pad

from bench.scenes.embedded.solids import Triple

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
    return pick(phase - phase.floor() < 0.5, first, second)


@texture
def chevrons(first: Colour, second: Colour, period: float, slope: float, points: Tensor) -> Tensor:
    """Zigzag stripes along x that repeat every `period`."""
    x, _, z = points.unbind(1)
    phase = x / period + slope * ((z / period - (z / period).floor()) - 0.5).abs()
    return pick(phase - phase.floor() < 0.5, first, second)


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
    return mix((phase - phase.floor()) ** 2, light, dark)


@texture
def mottled(first: Colour, second: Colour, scale: float, points: Tensor) -> Tensor:
    """Two octaves of noise that blend two colours."""
    share = 0.65 * noise(points * scale) + 0.35 * noise(points * (4.3 * scale))
    return mix(share, first, second)


@texture
def placed(paint: Texture, frame: Tensor, centre: Triple, points: Tensor) -> Tensor:
    """The texture of a part with this frame as if it had the building's."""
    return paint(points @ frame.T + points.new_tensor(centre))


@texture
def bricks(
    dark: Colour, light: Colour, mortar: Colour, size: tuple[float, float, float], points: Tensor
) -> Tensor:
    """Bricks of a length and a height, with joints of a width."""
    length, course, joint = size
    x, y, z = points.unbind(1)
    row, column, inside = cells(x + y, z, length, course)
    brick = mix(tone(row, column), dark, light)
    colour = torch.where((inside < joint / 2)[:, None], points.new_tensor(mortar), brick)
    return worn(colour, points)


@texture
def planks(
    dark: Colour, light: Colour, size: tuple[float, float], level: bool, points: Tensor
) -> Tensor:
    """Boards of a width, with gaps of a width: upright in a wall, or `level` along y in a floor."""
    width, gap = size
    x, y, z = points.unbind(1)
    across, along = (x, y + z) if level else (x + y, z)
    board = (across / width).floor()
    off = (across / width - board - 0.5).abs()
    grain = noise(torch.stack((across * 150, along * 9, board), dim=1))
    share = 0.5 * tone(board, board) + 0.5 * grain
    shut = off < 0.5 - gap / width / 2
    return worn(mix(share, dark, light), points) * torch.where(shut, 1.0, 0.3)[:, None]


@texture
def tiles(
    dark: Colour, light: Colour, moss: Colour, size: tuple[float, float], points: Tensor
) -> Tensor:
    """Rounded tiles of a width and a height on a roof whose frame has its ridge towards +y."""
    width, height = size
    x, y, _ = points.unbind(1)
    row, column, _ = cells(x, y, width, height)
    across = x / width + row / 2 - column - 0.5
    up = y / height - row
    # Below its round lower edge a tile shows the tile under it, in its shadow.
    edge = up - 1.6 * across * across
    colour = mix(tone(row, column), dark, light)
    patches = noise(points * 7)
    grown = (3 * (patches + 0.5 * noise(points * 60)) - 2.9).clamp(0, 0.8)
    colour = colour + grown[:, None] * (points.new_tensor(moss) - colour)
    shade = 0.35 + 0.65 * (edge * 5).clamp(0, 1)
    return worn(colour, points) * shade[:, None]


@texture
def setts(dark: Colour, light: Colour, grass: Colour, size: float, points: Tensor) -> Tensor:
    """Worn paving stones, with grass between them in places."""
    x, y, _ = points.unbind(1)
    bend = 0.3 * size * noise(points * (0.7 / size))
    row, column, inside = cells(x + bend, y + bend, 1.4 * size, size)
    colour = mix(tone(row, column), dark, light)
    joint = 0.12 * size * (0.5 + 2 * noise(points * 6))
    return worn(torch.where((inside < joint)[:, None], points.new_tensor(grass), colour), points)


@texture
def rough(dark: Colour, light: Colour, points: Tensor) -> Tensor:
    """Stone, paint or rust without a pattern of its own."""
    return worn(mix(noise(points * 25), dark, light), points)


@texture
def panes(dark: Colour, light: Colour, size: Triple, points: Tensor) -> Tensor:
    """Glass: each pane of a lattice shows another piece of sky."""
    x, y, z = (points / points.new_tensor(size) + 0.5).floor().unbind(1)
    share = 0.6 * tone(x + y, z) + 0.4 * noise(points * 9)
    return mix(share * share, dark, light)


def noise(points: Tensor) -> Tensor:
    """[N] in [0, 1]: random values at integer coordinates, smooth in between, with period 32."""
    table = lattice().to(points.dtype)
    cell = points.floor()
    part = points - cell
    # Trilinear at smoothstep coordinates, which avoids creases at the borders of cells.
    place = (cell + part * part * (3 - 2 * part)) / (table.shape[-1] - 1)
    place = (place - place.floor()) * 2 - 1  # [-1, 1] spans the table from first to last vertex
    sampled = grid_sample(table[None, None], place[None, None, None], align_corners=True)
    return sampled.reshape(-1)


@cache
def lattice() -> Tensor:
    """[33, 33, 33] random values; the last planes repeat the first ones."""
    values = torch.rand(32, 32, 32, generator=torch.Generator().manual_seed(1))
    return pad(values[None, None], (0, 1) * 3, mode="circular")[0, 0]


def pick(condition: Tensor, first: Colour, second: Colour) -> Tensor:
    """`first` where `condition` [N], else `second`: [N, 3]."""
    palette = torch.tensor((second, first))
    return palette[condition.long()]


def mix(share: Tensor, first: Colour, second: Colour) -> Tensor:
    """Blend from `first` at share 0 to `second` at share 1: [N, 3]."""
    start, end = share.new_tensor(first), share.new_tensor(second)
    return start + share[:, None] * (end - start)


def worn(colour: Tensor, points: Tensor) -> Tensor:
    """What stains, longer downwards than across, and grit leave of a colour."""
    stains = noise(points * points.new_tensor((11, 11, 4)))
    grit = noise(points * 170)
    return (colour * (0.54 + 0.45 * stains + 0.45 * grit)[:, None]).clamp(max=1)


def cells(u: Tensor, v: Tensor, length: float, course: float) -> tuple[Tensor, Tensor, Tensor]:
    """Row and column of pieces laid half a piece on, and the distance from their borders; [N]."""
    row = (v / course).floor()
    along = u / length + row / 2
    column = along.floor()
    aside = length * (0.5 - (along - column - 0.5).abs())
    above = course * (0.5 - (v / course - row - 0.5).abs())
    return row, column, torch.minimum(aside, above)


def tone(row: Tensor, column: Tensor) -> Tensor:
    """[N] in [0, 1]: a random value of each piece of a surface."""
    i, j = row.long(), column.long()
    # The last index makes the pattern repeat only after 1024 pieces.
    return lattice().to(row)[i % 32, j % 32, (i // 32 + 3 * (j // 32)) % 32]

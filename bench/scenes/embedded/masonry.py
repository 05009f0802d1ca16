"""Textures of buildings: small pieces, each with a tone of its own, stained and worn.

They repeat along x + y and z, so that a wall that faces x or y shows the same pattern, also around
a corner. A wall made of several parts takes `placed`, and its pattern goes on from part to part.
"""

from __future__ import annotations

import torch
from torch import Tensor

from bench.scenes.embedded.solids import Triple
from bench.scenes.embedded.textures import Colour, Texture, lattice, mix, noise, texture


@texture
def placed(paint: Texture, frame: Tensor | None, centre: Triple, points: Tensor) -> Tensor:
    """The texture of a part with this frame (None: not turned) as if it had the building's."""
    turned = points if frame is None else points @ frame.T.to(points)
    return paint(turned + points.new_tensor(centre))


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

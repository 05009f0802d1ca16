"""Heaps of random solids, one per variant number: an unlimited supply of training scenes.

Big parts form a core; smaller parts and rods are placed on its surface, half inside, so that parts
touch, cross and occlude one another. All draws use `random.Random(variant).random`, whose sequence
Python promises never to change; other methods of `Random` may change.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Sequence
from colorsys import hsv_to_rgb
from typing import TypeVar

from bench.scenes.embedded import textures
from bench.scenes.embedded.raytrace import Part, Solids
from bench.scenes.embedded.solids import (
    Box,
    Capsule,
    Carved,
    Common,
    Cylinder,
    Ellipsoid,
    Shape,
    Shifted,
    Triple,
    ball,
)
from bench.scenes.embedded.textures import Colour, Texture

Item = TypeVar("Item")

REACH = 1.2  # all parts lie in a ball of this radius, inside the models' cube and every picture
CORE = 5  # core parts, on which the other parts are placed
FINEST = 0.016  # width of stripes and dots: two pixels in a picture 400 pixels wide


class Draw:
    """Draws random numbers and choices from one stream."""

    def __init__(self, variant: int) -> None:
        self.share = random.Random(variant).random

    def between(self, low: float, high: float) -> float:
        return low + (high - low) * self.share()

    def small(self, low: float, high: float) -> float:
        """A number from `low` to `high`, more often near `low`."""
        return low + (high - low) * self.share() ** 2

    def whole(self, low: int, high: int) -> int:
        """A whole number from `low` to `high`, both included."""
        return low + int((high + 1 - low) * self.share())

    def pick(self, items: Sequence[Item]) -> Item:
        return items[self.whole(0, len(items) - 1)]

    def deck(self, items: Sequence[Item], count: int) -> list[Item]:
        """Draw `count` items in random order; none repeats before all have been drawn."""
        drawn: list[Item] = []
        while len(drawn) < count:
            drawn += sorted(items, key=lambda _: self.share())
        return drawn[:count]

    def direction(self) -> Triple:
        x, y, z = (self.between(-1, 1) for _ in range(3))
        length = max(math.sqrt(x * x + y * y + z * z), 1e-3)
        return (x / length, y / length, z / length)


def medley(variant: int) -> Solids:
    """Heap number `variant`: a core of five bulky solids, with 8 to 11 parts of any kind on it."""
    draw = Draw(variant)
    more = draw.whole(8, 11)
    shapes = [
        *(SHAPES[kind](draw, draw.between(0.36, 0.56)) for kind in draw.deck(BULKY, CORE)),
        *(SHAPES[kind](draw, draw.between(0.10, 0.36)) for kind in draw.deck(SMALLER, more)),
    ]
    painters = [*draw.deck(PATTERNS, CORE), *draw.deck(PAINTERS, more)]
    colours = palette(draw)
    parts: list[Part] = []
    for shape, paint in zip(shapes, painters, strict=True):
        part = Part(
            shape,
            paint(draw, colours, sorted(shape.extent())[1]),
            place(draw, shape, parts[:CORE]),
            (draw.between(-180, 180), draw.between(-180, 180), draw.between(-180, 180)),
            gloss=draw.between(0.2, 0.9) if draw.share() < 0.45 else 0.0,
            sharpness=draw.small(15, 150),
        )
        parts.append(part)
    return Solids(parts)


def place(draw: Draw, shape: Shape, core: Sequence[Part]) -> Triple:
    """The centre of a part: 0, then around the first, then on the outer side of a core part."""
    if not core:
        return (0.0, 0.0, 0.0)
    ground = draw.pick(core) if len(core) == CORE else core[0]
    outward = ground.centre
    if len(core) in (2, 4):  # opposite to the previous part
        outward = scaled(core[-1].centre, -1)
    direction = draw.direction()
    if dot(direction, outward) < 0:
        direction = scaled(direction, -1)
    # On an ellipsoid that fits inside every bulky shape; in the part's frame, then in the model's.
    axes = ground.frame.T.tolist()
    steps = (dot(axis, direction) * h for axis, h in zip(axes, ground.shape.extent(), strict=True))
    centre = ground.centre
    for axis, step in zip(axes, steps, strict=True):
        x, y, z = (c + step * a for c, a in zip(centre, axis, strict=True))
        centre = (x, y, z)
    inward = min(1.0, (REACH - norm(shape.extent())) / max(norm(centre), 1e-3))
    return scaled(centre, inward)


def dot(first: Sequence[float], second: Sequence[float]) -> float:
    return sum(a * b for a, b in zip(first, second, strict=True))


def norm(vector: Triple) -> float:
    return math.sqrt(dot(vector, vector))


def scaled(vector: Sequence[float], factor: float) -> Triple:
    x, y, z = vector
    return x * factor, y * factor, z * factor


def die(draw: Draw, size: float) -> Shape:
    half = 0.8 * size
    sides = (half, draw.between(0.8, 1.0) * half, draw.between(0.8, 1.0) * half)
    return Common(Box(sides), ball(1.1 * size))


def beam(draw: Draw, size: float) -> Shape:
    thick = draw.between(0.02, 0.06)
    return Box((thick, draw.between(0.6, 2.0) * thick, draw.between(0.35, 0.8)))


def bowl(draw: Draw, size: float) -> Shape:
    size = 1.2 * size
    bite = ball(draw.between(0.75, 0.95) * size)
    return Carved(ball(size), [Shifted(bite, (0.0, 0.0, 0.5 * size))])


def niches(draw: Draw, size: float) -> Shape:
    bite = ball(draw.between(0.5, 0.75) * size)
    sides = [(size, 0.0, 0.0), (-size, 0.0, 0.0), (0.0, size, 0.0), (0.0, -size, 0.0)]
    body = Box((size, size, draw.between(0.5, 1.0) * size))
    return Carved(body, [Shifted(bite, side) for side in sides])


def ring(draw: Draw, size: float) -> Shape:
    size = 1.5 * size
    bore = Cylinder(draw.between(0.75, 0.94) * size, 2 * size)
    return Carved(Cylinder(size, draw.between(0.1, 0.7) * size), [Shifted(bore, (0.0, 0.0, 0.0))])


def window(draw: Draw, size: float) -> Shape:
    x, y, thin = 1.5 * size, draw.between(0.9, 1.5) * size, draw.between(0.02, 0.05)
    opening = Box((0.4 * x, 0.4 * y, 2 * thin))
    places = [(s * 0.46 * x, t * 0.46 * y, 0.0) for s in (-1, 1) for t in (-1, 1)]
    return Carved(Box((x, y, thin)), [Shifted(opening, place) for place in places])


SHAPES: dict[str, Callable[[Draw, float], Shape]] = {
    "ball": lambda draw, size: ball(size),
    "egg": lambda draw, size: Ellipsoid(
        (size, draw.between(0.5, 0.9) * size, draw.between(0.7, 1.4) * size)
    ),
    "block": lambda draw, size: Box(
        (draw.between(0.55, 1) * size, draw.between(0.55, 1) * size, draw.between(0.55, 1) * size)
    ),
    "drum": lambda draw, size: Cylinder(draw.between(0.5, 0.9) * size, draw.between(0.4, 1) * size),
    "die": die,
    "barrel": lambda draw, size: Common(
        Cylinder(0.75 * size, draw.between(0.5, 0.9) * size), ball(size)
    ),
    "plate": lambda draw, size: Box(
        (1.5 * size, draw.between(0.5, 1.3) * size, draw.between(0.015, 0.05))
    ),
    "disc": lambda draw, size: Cylinder(1.4 * size, draw.between(0.012, 0.04)),
    "petal": lambda draw, size: Ellipsoid(
        (1.7 * size, draw.between(0.02, 0.05), draw.between(0.4, 0.9) * size)
    ),
    "beam": beam,
    "pill": lambda draw, size: Capsule(draw.between(0.3, 0.5) * size, size),
    # Two to six pixels across in a picture 400 wide.
    "rod": lambda draw, size: Capsule(draw.small(0.007, 0.024), draw.between(0.4, 0.95)),
    "bowl": bowl,
    "niches": niches,
    "ring": ring,
    "window": window,
}
"""Functions that make a solid, by kind. Each takes a size, roughly half the width of the solid."""

BULKY = ("ball", "egg", "block", "drum", "die", "barrel")
FLAT, LONG = ("plate", "disc", "petal"), ("beam", "pill", "rod", "rod", "rod")
SMALLER = (*FLAT, *LONG, "bowl", "niches", "ring", "window", "ball", "block", "drum", "barrel")


def palette(draw: Draw) -> list[Colour]:
    """Six, eight or ten colours of all hues, alternately light and dark."""
    start = draw.share()
    return [
        hsv_to_rgb(
            start + 0.618 * k,  # the golden angle: neighbours are far apart
            draw.between(0.1, 0.95),
            draw.between(0.1, 0.65) if k % 2 else draw.between(0.8, 1.0),
        )
        for k in range(2 * draw.whole(3, 5))
    ]


def pair(draw: Draw, colours: list[Colour]) -> tuple[Colour, Colour]:
    """A light and a dark colour, in random order."""
    light, dark = draw.pick(colours[::2]), draw.pick(colours[1::2])
    return (light, dark) if draw.share() < 0.5 else (dark, light)


def rings(draw: Draw, colours: list[Colour], size: float) -> Texture:
    width = stripe(draw, size) + FINEST  # it narrows towards the axis
    return textures.polar_checker(*pair(draw, colours), 2 * around(size, width), width)


def screw(draw: Draw, colours: list[Colour], size: float) -> Texture:
    width = stripe(draw, size) + FINEST  # it narrows towards the axis and where it winds
    twist = draw.between(-1.2, 1.2) / max(size, 0.05)
    return textures.spiral(*pair(draw, colours), around(size, width), twist)


def dots(draw: Draw, colours: list[Colour], size: float) -> Texture:
    radius = 0.7 * stripe(draw, size)
    return textures.pips(*pair(draw, colours), draw.between(2.2, 3.5) * radius, radius)


def stripe(draw: Draw, size: float) -> float:
    """A random stripe width for a part of this size, more often fine than coarse."""
    return draw.small(FINEST, max(0.4 * size, 2 * FINEST))


def around(size: float, width: float) -> int:
    """How many pairs of stripes of `width` fit around a part."""
    return max(round(math.pi * size / width), 2)


Painter = Callable[[Draw, list[Colour], float], Texture]

PATTERNS: tuple[Painter, ...] = (
    lambda draw, colours, size: textures.checker(*pair(draw, colours), stripe(draw, size)),
    rings,
    screw,
    lambda draw, colours, size: textures.chevrons(
        *pair(draw, colours), 2 * stripe(draw, size), draw.between(0.5, 2.5)
    ),
    dots,
    lambda draw, colours, size: textures.marble(*pair(draw, colours), 0.3 / stripe(draw, size)),
    lambda draw, colours, size: textures.wood(*pair(draw, colours), 0.5 / stripe(draw, size)),
    lambda draw, colours, size: textures.mottled(*pair(draw, colours), 0.3 / stripe(draw, size)),
)
PAINTERS: tuple[Painter, ...] = (
    *PATTERNS,
    lambda draw, colours, size: textures.plain(draw.pick(colours)),
    lambda draw, colours, size: textures.eye(draw.pick(colours)),
)
"""Functions that make a texture from some of the colours, for a part of the given size."""

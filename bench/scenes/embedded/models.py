"""The embedded scenes: z is up, everything lies in [-1.2, 1.2]^3, the totem faces -y."""

import math
from collections.abc import Callable
from itertools import combinations, pairwise

from bench.scenes.embedded.raytrace import Ball, Media, Part, SceneModel, Solids
from bench.scenes.embedded.solids import (
    Capsule,
    Carved,
    Common,
    Cuboid,
    Cylinder,
    Ellipsoid,
    Shifted,
    Triple,
    ball,
)
from bench.scenes.embedded.textures import (
    Colour,
    checker,
    chevrons,
    eye,
    marble,
    mottled,
    pips,
    plain,
    polar_checker,
    spiral,
    wood,
)

IVORY, INK, CORAL = (0.95, 0.92, 0.84), (0.09, 0.10, 0.14), (0.90, 0.27, 0.20)
TEAL, NAVY, GOLD = (0.08, 0.55, 0.56), (0.10, 0.18, 0.38), (0.96, 0.70, 0.14)
SLATE, PLUM, LEAF = (0.34, 0.37, 0.42), (0.47, 0.16, 0.42), (0.42, 0.66, 0.22)
PINE, BARK = (0.76, 0.52, 0.28), (0.40, 0.23, 0.10)


def totem() -> Solids:
    """Stacked textured and glossy solids that occlude one another; the scene of the demo."""
    return Solids([*pedestal(), *face(), *crown()])


def pedestal() -> list[Part]:
    """A disc, a marble block with a ball in each of its four niches, and a drum."""
    niches = [(0.42, 0.0, 0.0), (-0.42, 0.0, 0.0), (0.0, 0.42, 0.0), (0.0, -0.42, 0.0)]
    block = Carved(Cuboid((0.42, 0.42, 0.24)), [Shifted(ball(0.21), niche) for niche in niches])
    c, s = math.cos(math.radians(18)), math.sin(math.radians(18))
    patterns = plain(CORAL), spiral(IVORY, TEAL, 8, 4.0), plain(GOLD), mottled(NAVY, TEAL, 14.0)
    balls = [
        Part(ball(0.15), pattern, (x * c - y * s, x * s + y * c, -0.85), gloss=0.7)
        for (x, y, _), pattern in zip(niches, patterns, strict=True)
    ]
    return [
        Part(Cylinder(0.76, 0.05), polar_checker(SLATE, IVORY, 48, 0.06), (0, 0, -1.09)),
        Part(Cylinder(0.64, 0.02), plain(CORAL), (0, 0, -1.02), gloss=0.3),
        Part(block, marble(IVORY, SLATE, 3.0), (0, 0, -0.76), (0, 0, 18), gloss=0.15),
        *balls,
        Part(Cylinder(0.40, 0.015), plain(GOLD), (0, 0, -0.505), gloss=0.6),
        Part(Cylinder(0.37, 0.13), spiral(CORAL, IVORY, 24, 2.5), (0, 0, -0.36)),
        Part(Cylinder(0.40, 0.015), plain(GOLD), (0, 0, -0.215), gloss=0.6),
    ]


def face() -> list[Part]:
    """A striped head with eyes, a beak, ears and two feathered wings."""
    eyes = [
        Part(ball(0.13), eye(colour), (side * 0.19, -0.34, 0.20), (0, 0, side * 12), gloss=0.9)
        for side, colour in ((-1, LEAF), (1, GOLD))
    ]
    wings = [
        Part(
            Ellipsoid((0.42, 0.045, 0.17)),
            chevrons(TEAL if row else CORAL, IVORY, 0.075, 1.0),
            (side * (0.70 - 0.06 * row), 0.06, 0.14 - 0.2 * row),
            (0, side * (-22 + 16 * row), side * 8),
            gloss=0.1,
        )
        for side in (-1, 1)
        for row in (0, 1)
    ]
    return [
        Part(Ellipsoid((0.45, 0.42, 0.34)), spiral(TEAL, NAVY, 36, 0.9), (0, 0, 0.10), gloss=0.25),
        Part(Ellipsoid((0.085, 0.26, 0.07)), plain(GOLD), (0, -0.48, 0.02), (-14, 0, 0), gloss=0.6),
        Part(Ellipsoid((0.07, 0.17, 0.035)), plain(CORAL), (0, -0.42, -0.09), (6, 0, 0), gloss=0.3),
        *eyes,
        *wings,
    ]


def crown() -> list[Part]:
    """A wooden collar, a rounded die, and a ring of pins around a golden ball."""
    die = Common(Cuboid((0.22, 0.22, 0.20)), ball(0.31))
    pins, tips = [], []
    for k in range(9):
        a = math.radians(40 * k + 10)
        c, s = math.cos(a), math.sin(a)
        pin, tip = plain(INK if k % 2 else PLUM), plain((CORAL, GOLD, TEAL)[k % 3])
        turn = (0, 30, math.degrees(a))
        pins.append(Part(Capsule(0.016, 0.12), pin, (0.22 * c, 0.22 * s, 0.93), turn))
        tips.append(Part(ball(0.045), tip, (0.29 * c, 0.29 * s, 1.05), gloss=0.8))
    return [
        Part(Cylinder(0.30, 0.05), wood(PINE, BARK, 34.0), (0, 0, 0.44)),
        Part(die, pips(IVORY, INK, 0.11, 0.031), (0, 0, 0.66), (0, 0, 33), gloss=0.3),
        Part(Cylinder(0.20, 0.02), checker(INK, IVORY, 0.05), (0, 0, 0.85)),
        Part(ball(0.13), mottled(GOLD, (0.80, 0.46, 0.05), 9.0), (0, 0, 0.97), gloss=0.9),
        *pins,
        *tips,
    ]


def wires() -> Solids:
    """Thin structures: a cage, a helix and a spoked wheel, 0.012 and 0.02 thick."""
    return Solids([*cage(), *helix(), *wheel()])


def wire(start: Triple, end: Triple, radius: float, colour: Colour) -> Part:
    x, y, z = (b - a for a, b in zip(start, end, strict=True))
    cx, cy, cz = ((a + b) / 2 for a, b in zip(start, end, strict=True))
    length = math.sqrt(x * x + y * y + z * z)
    turn = (0.0, math.degrees(math.acos(z / length)), math.degrees(math.atan2(y, x)))
    return Part(Capsule(radius, length / 2), plain(colour), (cx, cy, cz), turn, gloss=0.3)


def cage() -> list[Part]:
    """Edges of a cube, and a grid of bars on two of its faces."""
    h, radius = 0.8, 0.010
    corners = [(x, y, z) for x in (-h, h) for y in (-h, h) for z in (-h, h)]
    edges = [
        wire(a, b, radius, INK)
        for a, b in combinations(corners, 2)
        if sum(p != q for p, q in zip(a, b, strict=True)) == 1
    ]
    bars = [
        wire((x, side, -h), (x, side, h), 0.006, colour)
        for side, colour in ((-h, CORAL), (h, TEAL))
        for x in (-0.6, -0.4, -0.2, 0.0, 0.2, 0.4, 0.6)
    ]
    return edges + bars


def helix() -> list[Part]:
    steps = 72
    points = [
        (0.45 * math.cos(0.35 * k), 0.45 * math.sin(0.35 * k), -0.7 + 1.4 * k / steps)
        for k in range(steps + 1)
    ]
    return [wire(a, b, 0.010, GOLD) for a, b in pairwise(points)]


def wheel() -> list[Part]:
    """A rim of straight pieces and spokes, upright."""
    pieces = 32
    rim = [
        (0.3 * math.cos(2 * math.pi * k / pieces), 0.0, 0.3 * math.sin(2 * math.pi * k / pieces))
        for k in range(pieces)
    ]
    tyre = [wire(a, b, 0.010, NAVY) for a, b in zip(rim, rim[1:] + rim[:1], strict=True)]
    return tyre + [wire((0.0, 0.0, 0.0), point, 0.006, SLATE) for point in rim[::2]]


def cloud() -> Media:
    """Overlapping homogeneous balls, from thin to nearly opaque."""
    return Media(
        [
            Ball((0.00, 0.00, -0.45), 0.55, 2.2, (0.93, 0.94, 0.97)),
            Ball((0.42, 0.10, -0.25), 0.42, 3.0, (0.96, 0.80, 0.58)),
            Ball((-0.46, -0.08, -0.30), 0.45, 2.6, (0.62, 0.74, 0.94)),
            Ball((0.10, 0.30, 0.10), 0.48, 1.4, (0.95, 0.62, 0.66)),
            Ball((-0.18, -0.26, 0.12), 0.40, 4.0, (0.99, 0.97, 0.90)),
            Ball((0.30, -0.32, 0.28), 0.26, 8.0, (0.93, 0.45, 0.32)),
            Ball((-0.42, 0.28, 0.36), 0.30, 6.0, (0.42, 0.52, 0.86)),
            Ball((0.02, 0.02, 0.55), 0.34, 1.0, (0.80, 0.90, 0.78)),
            Ball((0.20, 0.06, 0.72), 0.12, 30.0, (0.98, 0.80, 0.22)),
            Ball((-0.55, -0.45, -0.62), 0.20, 14.0, (0.30, 0.62, 0.55)),
            Ball((0.66, 0.48, -0.58), 0.22, 0.6, (0.70, 0.40, 0.75)),
        ]
    )


def void() -> Solids:
    """Almost nothing: one small ball off the centre."""
    return Solids([Part(ball(0.06), plain(CORAL), (0.35, -0.2, 0.15), gloss=0.5)])


MODELS: dict[str, Callable[[], SceneModel]] = {
    make.__name__: make for make in (totem, wires, cloud, void)
}

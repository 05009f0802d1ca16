"""Pieces of buildings. Their textures go on from one piece to the next; see `masonry`."""

from __future__ import annotations

import math

from bench.scenes.embedded.masonry import placed
from bench.scenes.embedded.raytrace import Part, rotation
from bench.scenes.embedded.solids import Cuboid, Cylinder, Pierced, Shape, Triple
from bench.scenes.embedded.textures import Texture

UPRIGHT = (0.0, 0.0, 0.0)


def put(
    shape: Shape,
    paint: Texture,
    centre: Triple,
    turn: Triple = UPRIGHT,
    gloss: float = 0.0,
    sharpness: float = 12.0,  # broad: few viewers are where a flat surface reflects the light to
) -> Part:
    frame = rotation(*turn) if any(turn) else None
    return Part(shape, placed(paint, frame, centre), centre, turn, gloss, sharpness)


def block(low: Triple, high: Triple, paint: Texture, gloss: float = 0.0) -> Part:
    """A box between two corners."""
    x, y, z = ((b - a) / 2 for a, b in zip(low, high, strict=True))
    return put(Cuboid((x, y, z)), paint, between(low, high), gloss=gloss)


def rod(start: Triple, end: Triple, radius: float, paint: Texture, gloss: float = 0.0) -> Part:
    x, y, z = (b - a for a, b in zip(start, end, strict=True))
    length = math.sqrt(x * x + y * y + z * z)
    turn = (0.0, math.degrees(math.acos(z / length)), math.degrees(math.atan2(y, x)))
    return put(Cylinder(radius, length / 2), paint, between(start, end), turn, gloss)


def rail(start: Triple, end: Triple, height: float, paint: Texture) -> Part:
    """A railing whose lower edge goes from `start` to `end`, also up a stair."""
    x, y, z = (b - a for a, b in zip(start, end, strict=True))
    length = math.sqrt(x * x + y * y + z * z)
    count = round(length / 0.035)
    hole = (length / count / 2 - 0.0035, height / 2 - 0.006)
    shape = Pierced((length / 2, 0.005, height / 2), (count, 1), hole)
    turn = (0.0, -math.degrees(math.asin(z / length)), math.degrees(math.atan2(y, x)))
    return put(shape, paint, raised(between(start, end), height / 2), turn)


def slope(
    ridge: Triple,  # the middle of the upper edge
    length: float,  # half of the edge
    run: float,  # how far the slope reaches, measured on the level
    pitch: float,  # in degrees
    turn: float,  # about z; at 0 the slope falls to -y
    tile: Texture,
    timber: Texture,
) -> list[Part]:
    """Tiles, and under the eaves the ends of rafters."""
    c, t, a = math.cos(math.radians(pitch)), math.tan(math.radians(pitch)), math.radians(turn)
    half, thick, eave = run / c / 2, 0.010, 0.09

    def below(away: float, lift: float) -> Triple:
        """The point `away` from the ridge, on the level, and `lift` above the slope."""
        x, y, z = ridge
        return (x + math.sin(a) * away, y - math.cos(a) * away, z - away * t + lift / c)

    count = round(2 * length / 0.06)
    hole = (length / count - 0.008, eave - 0.012)
    rafters = Pierced((length - 0.01, thick, eave), (count, 1), hole)
    return [
        Part(Cuboid((length, half, thick)), tile, below(run / 2, thick), (pitch, 0.0, turn)),
        put(rafters, timber, below(run - (eave + 0.02) * c, -thick), (pitch - 90.0, 0.0, turn)),
    ]


def between(start: Triple, end: Triple) -> Triple:
    x, y, z = ((a + b) / 2 for a, b in zip(start, end, strict=True))
    return (x, y, z)


def raised(point: Triple, height: float) -> Triple:
    return (point[0], point[1], point[2] + height)

"""A brick mill in a paved yard: the size, the detail and the dark corners of a real building.

Lengths are written as if the ground were at z = 0; the front faces -y. No bar, rope or rung is
thinner than 0.007, a 300th of the whole; joints between bricks are 0.003 wide.
"""

import math
from dataclasses import replace

from bench.scenes.embedded.raytrace import Part, Solids, along, rotation
from bench.scenes.embedded.solids import (
    Carved,
    Common,
    Cuboid,
    Cylinder,
    Ellipsoid,
    Gable,
    Pierced,
    Shape,
    Triple,
    ball,
)
from bench.scenes.embedded.textures import (
    Texture,
    bricks,
    panes,
    placed,
    planks,
    rough,
    setts,
    tiles,
)

SUNK = 0.53  # how far the ground lies below the centre of the pictures

BRICK = bricks((0.40, 0.17, 0.12), (0.80, 0.44, 0.31), (0.80, 0.75, 0.66), (0.034, 0.012, 0.003))
QUOIN = bricks((0.62, 0.57, 0.47), (0.88, 0.83, 0.72), (0.40, 0.36, 0.30), (0.160, 0.045, 0.004))
STONE = rough((0.62, 0.57, 0.47), (0.86, 0.81, 0.70))
TILE = tiles((0.30, 0.22, 0.20), (0.76, 0.53, 0.42), (0.40, 0.43, 0.18), (0.030, 0.026))
BOARD = planks((0.30, 0.25, 0.20), (0.66, 0.57, 0.46), (0.030, 0.004), False)
FLOOR = planks((0.34, 0.28, 0.22), (0.68, 0.60, 0.48), (0.030, 0.004), True)
GREEN = planks((0.08, 0.24, 0.20), (0.18, 0.42, 0.35), (0.028, 0.004), False)
TIMBER = rough((0.24, 0.17, 0.12), (0.50, 0.38, 0.27))
PAINT = rough((0.78, 0.76, 0.70), (0.94, 0.92, 0.86))
IRON = rough((0.16, 0.16, 0.18), (0.40, 0.28, 0.22))
SACK = rough((0.60, 0.52, 0.38), (0.80, 0.72, 0.56))
BRASS = rough((0.86, 0.62, 0.18), (0.98, 0.78, 0.30))
GLASS = panes((0.05, 0.08, 0.12), (0.50, 0.60, 0.70), (0.040, 0.044, 0.045))
YARD = setts((0.36, 0.34, 0.32), (0.76, 0.72, 0.66), (0.24, 0.30, 0.13), 0.030)

LONG, DEEP = 0.70, 0.44  # half sizes of the house
FOOT, HIGH = 0.05, 0.86  # its walls are from there to there
PITCH = 38.0  # of its roof, in degrees
SLANT = math.tan(math.radians(PITCH))
TOP = HIGH + DEEP * SLANT  # of its gables
RIDGE = TOP + 0.025  # of its roof, under the tiles
FALL = 0.10  # how far the roof projects
STOREYS, BAYS = 3, (7, 4)  # rows of windows, and windows in a row of a long and of a short wall
WINDOW = (0.0525, 0.085)  # half sizes


def put(
    shape: Shape,
    paint: Texture,
    centre: Triple,
    turn: Triple = (0.0, 0.0, 0.0),
    gloss: float = 0.0,
    sharpness: float = 12.0,  # broad: few viewers are where a flat surface reflects the light to
) -> Part:
    return Part(shape, placed(paint, rotation(*turn), centre), centre, turn, gloss, sharpness)


def block(low: Triple, high: Triple, paint: Texture, gloss: float = 0.0) -> Part:
    x, y, z = ((b - a) / 2 for a, b in zip(low, high, strict=True))
    _, middle, _ = along(low, high)
    return put(Cuboid((x, y, z)), paint, middle, gloss=gloss)


def rod(start: Triple, end: Triple, radius: float, paint: Texture, gloss: float = 0.0) -> Part:
    length, middle, turn = along(start, end)
    return put(Cylinder(radius, length / 2), paint, middle, turn, gloss)


def rail(start: Triple, end: Triple, height: float, paint: Texture) -> Part:
    """A railing whose lower edge goes from `start` to `end`, also up a stair."""
    length, (x, y, z), (_, _, azimuth) = along(start, end)
    count = round(length / 0.035)
    hole = (length / count / 2 - 0.0035, height / 2 - 0.006)
    shape = Pierced((length / 2, 0.005, height / 2), (count, 1), hole)
    pitch = -math.degrees(math.asin((end[2] - start[2]) / length))
    return put(shape, paint, (x, y, z + height / 2), (0.0, pitch, azimuth))


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


def mill() -> Solids:
    """A mill with rows of windows, a water wheel, a porch, a shed and an outside stair."""
    house = [*walls(), *gables(), *bands(), *roof(), *gutters(), *crown(), *hoist()]
    around = [*porch(), *door(), *wheel(), *flume(), *shed(), *stair(), *yard(), *goods()]
    places = ((part, *part.centre) for part in house + around)
    return Solids([replace(part, centre=(x, y, z - SUNK)) for part, x, y, z in places])


def walls() -> list[Part]:
    """Walls with holes, bars behind these, and then glass."""
    parts = [block((0.04 - LONG, 0.04 - DEEP, 0.0), (LONG - 0.04, DEEP - 0.04, HIGH), GLASS, 0.5)]
    height, middle = (HIGH - FOOT) / 2, (HIGH + FOOT) / 2
    for length, out, bays, turn in ((LONG, DEEP, BAYS[0], 0.0), (DEEP, LONG, BAYS[1], 90.0)):
        wall = Pierced((length, 0.015, height), (bays, STOREYS), WINDOW)
        columns, rows = 5 * bays, 6 * STOREYS
        hole = (length / columns - 0.0035, height / rows - 0.0035)
        bars = Pierced((length, 0.004, height), (columns, rows), hole)
        for side in (-1, 1):
            for plate, paint, away in ((wall, BRICK, out - 0.015), (bars, PAINT, out - 0.034)):
                x, y = (side * away, 0.0) if turn else (0.0, side * away)
                parts.append(put(plate, paint, (x, y, middle), (0.0, 0.0, turn)))
    return parts


def gables() -> list[Part]:
    """Each with a round window."""
    rise, z, out, lie = (TOP - HIGH) / 2, HIGH + 0.15, LONG + 0.02, (0.0, 90.0, 0.0)
    return [
        put(Gable((LONG, DEEP, rise)), BRICK, (0.0, 0.0, HIGH + rise)),
        put(Cylinder(0.085, LONG + 0.012), STONE, (0.0, 0.0, z), lie),
        put(Cylinder(0.065, LONG + 0.015), GLASS, (0.0, 0.0, z), lie, gloss=0.5),
        block((-out, -0.065, z - 0.004), (out, 0.065, z + 0.004), PAINT),
        block((-out, -0.004, z - 0.065), (out, 0.004, z + 0.065), PAINT),
    ]


def bands() -> list[Part]:
    """Courses of stone all around, and the corners."""
    parts = [course(0.0, FOOT, 0.014, QUOIN), course(HIGH - 0.03, HIGH, 0.022, STONE)]
    for storey in range(STOREYS):
        middle = FOOT + (storey + 0.5) * (HIGH - FOOT) / STOREYS
        sill, lintel = middle - WINDOW[1], middle + WINDOW[1]
        parts.append(course(sill - 0.018, sill, 0.014, STONE))
        parts.append(course(lintel, lintel + 0.02, 0.005, QUOIN))
    corner, x, y = Cuboid((0.0265, 0.0265, HIGH / 2)), LONG - 0.0185, DEEP - 0.0185
    places = [(x, y), (-x, y), (x, -y), (-x, -y)]
    return parts + [put(corner, QUOIN, (*place, HIGH / 2)) for place in places]


def course(low: float, high: float, out: float, paint: Texture) -> Part:
    """A part of all walls between two heights, `out` beyond their faces."""
    x, y = LONG + out, DEEP + out
    return block((-x, -y, low), (x, y, high), paint)


def roof() -> list[Part]:
    """Two slopes that project beyond the walls, with skylights in front."""
    parts = [put(Cylinder(0.022, LONG + 0.07), STONE, (0.0, 0.0, RIDGE + 0.01), (0.0, 90.0, 0.0))]
    for turn in (0.0, 180.0):
        parts += slope((0.0, 0.0, RIDGE), LONG + 0.07, DEEP + FALL, PITCH, turn, TILE, TIMBER)
    for x in (-0.42, 0.38):
        place, lie = (x, -0.30, RIDGE - 0.30 * SLANT + 0.024), (PITCH, 0.0, 0.0)
        parts.append(put(Cuboid((0.055, 0.075, 0.012)), IRON, place, lie))
        parts.append(put(Cuboid((0.045, 0.065, 0.015)), GLASS, place, lie, gloss=0.7))
    return parts


def gutters() -> list[Part]:
    """Along the eaves, and down at the corners."""
    parts, out, under = [], LONG + 0.07, HIGH - 0.02
    for side in (-1, 1):
        y, z = side * (DEEP + FALL + 0.01), TOP - (DEEP + FALL) * SLANT + 0.015
        parts.append(rod((-out, y, z), (out, y, z), 0.012, IRON, gloss=0.6))
        for x in (0.09 - LONG, LONG - 0.09):
            foot: Triple = (x, side * (DEEP + 0.02), 0.02)
            parts.append(rod(foot, (*foot[:2], under), 0.009, IRON, gloss=0.6))
            parts.append(rod((*foot[:2], under), (x, y, z), 0.009, IRON, gloss=0.6))
    return parts


def crown() -> list[Part]:
    """A chimney and a vane."""
    x = -0.55
    return [
        block((0.40, -0.05, TOP - 0.12), (0.52, 0.05, TOP + 0.07), BRICK),
        block((0.39, -0.06, TOP + 0.07), (0.53, 0.06, TOP + 0.09), STONE),
        put(Cylinder(0.022, 0.025), TIMBER, (0.435, 0.0, TOP + 0.105)),
        put(Cylinder(0.022, 0.025), TIMBER, (0.485, 0.0, TOP + 0.105)),
        rod((x, 0.0, TOP), (x, 0.0, TOP + 0.135), 0.006, IRON),
        put(ball(0.02), BRASS, (x, 0.0, TOP + 0.065), gloss=0.8, sharpness=60.0),
        block((x - 0.07, -0.004, TOP + 0.10), (x + 0.05, 0.004, TOP + 0.125), BRASS, gloss=0.5),
    ]


def hoist() -> list[Part]:
    """A gabled box under the eaves, on brackets, and a sack on its rope."""
    front, z = -DEEP - 0.17, 0.93
    rope = front - 0.097
    parts = [
        block((-0.10, front, 0.66), (0.10, -0.20, z), BOARD),
        put(Gable((0.15, 0.10, 0.04)), BOARD, (0.0, front + 0.15, z + 0.04), (0.0, 0.0, 90.0)),
        block((-0.045, front - 0.006, 0.70), (0.045, front + 0.01, 0.86), GREEN),
        block((-0.012, front - 0.09, 0.925), (0.012, front, 0.95), TIMBER),
        put(Cylinder(0.022, 0.008), IRON, (0.0, rope + 0.022, 0.91), (0.0, 90.0, 0.0)),
        rod((0.0, rope, 0.50), (0.0, rope, 0.91), 0.004, SACK),
        put(Ellipsoid((0.04, 0.035, 0.055)), SACK, (0.0, rope, 0.46)),
    ]
    for side in (-1, 1):
        ridge = (0.0, front + 0.15, z + 0.10)
        parts += slope(ridge, 0.20, 0.15, 38.66, 90.0 * side, TILE, TIMBER)
        parts.append(
            rod((side * 0.08, -DEEP, 0.56), (side * 0.08, front + 0.03, 0.66), 0.01, TIMBER)
        )
    return parts


def porch() -> list[Part]:
    """A roof on posts over a floor on stilts, with a railing and two steps."""
    front, wide, gap, floor = -DEEP - 0.26, 0.36, 0.12, 0.065
    y, z = front + 0.02, floor + 0.01
    parts = slope((0.0, 0.01 - DEEP, 0.37), wide + 0.05, 0.32, 20.0, 0.0, TILE, TIMBER)
    for side in (-1, 1):
        for x in (side * gap, side * wide):
            parts.append(
                block((x - 0.011, front + 0.01, 0.0), (x + 0.011, y + 0.012, 0.272), PAINT)
            )
        x = side * wide * 2 / 3
        parts.append(block((x - 0.012, y, 0.0), (x + 0.012, y + 0.03, floor - 0.02), TIMBER))
        parts.append(rail((side * gap, y, z), (side * wide, y, z), 0.085, PAINT))
        parts.append(rail((side * wide, y, z), (side * wide, -DEEP - 0.02, z), 0.085, PAINT))
    for k in range(2):
        high = 0.022 + 0.022 * k
        parts.append(block((-0.11, front - 0.05 + 0.025 * k, 0.0), (0.11, front, high), STONE))
    wide += 0.02
    return [
        *parts,
        block((-wide, front + 0.006, 0.262), (wide, front + 0.036, 0.282), PAINT),
        block((-wide, front, floor - 0.02), (wide, -DEEP, floor), FLOOR),
    ]


def door() -> list[Part]:
    """Under the porch, before the middle window."""
    return [
        block((-0.085, -DEEP - 0.012, 0.065), (0.085, -DEEP, 0.30), STONE),
        block((-0.065, -DEEP - 0.018, 0.065), (0.065, -DEEP, 0.28), GREEN),
        put(ball(0.008), BRASS, (0.012, -DEEP - 0.022, 0.16), gloss=0.8),
    ]


def wheel() -> list[Part]:
    """A water wheel at the right end, its outer bearing on a pier."""
    y, z, radius, lie = 0.02, 0.32, 0.30, (0.0, 90.0, 0.0)
    rim = Carved(Cylinder(radius, 0.008), [Cylinder(radius - 0.035, 0.02)])
    parts = [
        put(Cylinder(0.016, 0.14), IRON, (0.80, y, z), lie, gloss=0.4),
        block((0.90, y - 0.07, 0.0), (0.95, y + 0.07, z + 0.02), QUOIN),
    ]
    for x in (0.755, 0.875):
        parts.append(put(rim, TIMBER, (x, y, z), lie))
        for k in range(4):
            spoke = Cuboid((0.007, 0.010, radius - 0.01))
            parts.append(put(spoke, TIMBER, (x, y, z), (45.0 * k, 0.0, 0.0)))
    for k in range(18):
        a = math.radians(20.0 * k)
        centre = (0.815, y - 0.275 * math.sin(a), z + 0.275 * math.cos(a))
        parts.append(put(Cuboid((0.055, 0.005, 0.035)), BOARD, centre, (20.0 * k, 0.0, 0.0)))
    return parts


def flume() -> list[Part]:
    """A trough on trestles that brings the water to the wheel from behind."""
    low, high, start, end = 0.66, 0.715, 0.10, 0.54
    parts = [
        block((0.755, start, low), (0.875, end, low + 0.012), FLOOR),
        block((0.755, start, low), (0.763, end, high), BOARD),
        block((0.867, start, low), (0.875, end, high), BOARD),
    ]
    for y in (0.20, 0.36, 0.52):
        parts.append(rod((0.716, y, 0.0), (0.76, y, low), 0.009, TIMBER))
        parts.append(rod((0.914, y, 0.0), (0.87, y, low), 0.009, TIMBER))
        parts.append(rod((0.74, y, 0.30), (0.89, y, 0.30), 0.007, TIMBER))
    braces = [((0.90, y, 0.05), (0.885, y + 0.16, 0.60)) for y in (0.20, 0.36)]
    return parts + [rod(*ends, 0.006, TIMBER) for ends in braces]


def shed() -> list[Part]:
    """A boarded lean-to at the left end, with a double door in front and windows at its end."""
    far, pitch, high = -LONG - 0.28, 30.0, 0.30
    rise = 0.28 * math.tan(math.radians(pitch)) / 2
    parts = [
        block((far, -0.30, 0.0), (-LONG, 0.30, high), BOARD),
        block((far - 0.012, -0.312, 0.0), (-LONG, 0.312, 0.035), QUOIN),
        put(Gable((0.30, 0.28, rise)), BOARD, (-LONG, 0.0, high + rise), (0.0, 0.0, 90.0)),
        *slope((-LONG, 0.0, high + 2 * rise + 0.01), 0.35, 0.35, pitch, -90.0, TILE, TIMBER),
    ]
    for x in (-0.905, -0.79):
        left, right = x - 0.053, x + 0.053
        parts.append(block((left, -0.308, 0.04), (right, -0.295, 0.26), GREEN))
        parts.append(block((left, -0.314, 0.07), (right, -0.305, 0.09), PAINT))
        parts.append(block((left, -0.314, 0.22), (right, -0.305, 0.24), PAINT))
        brace = Cuboid((0.072, 0.004, 0.009))
        parts.append(put(brace, PAINT, (x, -0.311, 0.155), (0.0, -52.0, 0.0)))
    frame = Pierced((0.09, 0.012, 0.06), (2, 2), (0.039, 0.024))
    for y in (-0.14, 0.14):
        parts.append(put(frame, PAINT, (far, y, 0.17), (0.0, 0.0, 90.0)))
        parts.append(put(Cuboid((0.005, 0.09, 0.06)), GLASS, (far, y, 0.17), gloss=0.5))
    return parts


def stair() -> list[Part]:
    """Open steps to a door on the upper floor, behind the house."""
    near, far, top, steps = DEEP, DEEP + 0.16, 0.32, 11
    foot, head, end = -0.34, 0.08, 0.32
    edge = far - 0.01
    parts = [block((head, near, top - 0.015), (end, far, top), FLOOR)]
    for k in range(steps):
        x, z = foot + (head - foot) * k / steps, top * (k + 0.5) / steps
        parts.append(block((x - 0.022, near + 0.02, z - 0.006), (x + 0.022, far, z + 0.006), FLOOR))
    sides, posts = (near + 0.025, far - 0.005), (head + 0.02, end - 0.02)
    return [
        *parts,
        *(rod((foot, y, 0.0), (head, y, top - 0.02), 0.010, TIMBER) for y in sides),
        *(block((x - 0.01, far - 0.025, 0), (x + 0.01, far - 0.005, top), TIMBER) for x in posts),
        rail((foot, edge, 0.03), (head, edge, top + 0.02), 0.09, PAINT),
        rail((head, edge, top), (end, edge, top), 0.10, PAINT),
        rail((end, near, top), (end, far, top), 0.10, PAINT),
        block((0.135, near, top), (0.265, near + 0.012, top + 0.21), STONE),
        block((0.150, near, top), (0.250, near + 0.018, top + 0.195), GREEN),
    ]


def yard() -> list[Part]:
    """Paving with cut corners, a fence, and a ladder and a millstone that lean at the front."""
    slab = Common(Cuboid((1.0, 0.70, 0.02)), Cylinder(1.06, 0.02))
    ladder = Pierced((0.035, 0.006, 0.33), (1, 14), (0.026, 0.0195))
    stone, tilt = (0.55, -DEEP - 0.06, 0.096), (70.0, 0.0, 0.0)
    return [
        put(slab, YARD, (0.0, -0.04, -0.02)),
        rail((-0.86, -0.56, 0.0), (-0.58, -0.56, 0.0), 0.11, PAINT),
        put(ladder, TIMBER, (-0.50, -DEEP - 0.105, 0.32), (-15.0, 0.0, 0.0)),
        put(Cylinder(0.10, 0.020), STONE, stone, tilt),
        put(Cylinder(0.02, 0.024), IRON, stone, tilt),
    ]


def goods() -> list[Part]:
    """Barrels, sacks and crates."""
    barrel, sack, crate = Common(Cylinder(0.05, 0.06), ball(0.07)), (0.05, 0.04, 0.06), 0.045
    parts = []
    for x, y in ((0.80, -0.36), (0.90, -0.28), (-0.50, 0.56)):
        parts.append(put(barrel, BOARD, (x, y, 0.06)))
        parts.append(put(Cylinder(0.052, 0.006), IRON, (x, y, 0.06), gloss=0.4))
    for k, (x, y) in enumerate(((0.52, 0.56), (0.61, 0.58), (0.56, 0.50))):
        parts.append(put(Ellipsoid(sack), SACK, (x, y, 0.05), (0.0, 15.0 * k, 40.0 * k)))
    for k, centre in enumerate(((0.74, -0.57, crate), (0.85, -0.49, crate), (0.78, -0.54, 0.13))):
        parts.append(Part(Cuboid((0.05, 0.05, crate)), BOARD, centre, (0.0, 0.0, 25.0 * k + 10.0)))
    return parts

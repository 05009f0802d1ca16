"""Shapes whose intersection with a ray has a closed form.

Every shape is centred in its own frame. Rays are given by components: three for the origin and
three for the direction, which broadcast. A camera has one origin (three floats) and many
directions; a light at infinity has one direction and many origins. Positions along a ray are its
parameter t, +inf where the ray misses. Points are [N, 3].
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor

Triple = tuple[float, float, float]
Origin = tuple[Any, Any, Any]  # floats or tensors
Directions = tuple[Tensor, Tensor, Tensor]
Interval = tuple[Tensor, Tensor]


class Shape(Protocol):
    def extent(self) -> Triple:
        """Half sizes of a bounding box of the shape."""

    def hit(self, origin: Origin, directions: Directions) -> Tensor:
        """The first crossing of the surface at t > 0; +inf if there is none."""

    def distance(self, points: Tensor) -> Tensor:
        """[N] signed distance, negative inside; only approximate away from the surface."""

    def normal(self, points: Tensor) -> Tensor:
        """[N, 3]: outward unit normals at points of the surface."""


class Convex(Shape, Protocol):
    """A convex shape: its intersection with a ray is one interval."""

    def interval(self, origin: Origin, directions: Directions) -> Interval:
        """Where rays enter and leave; enter > leave if they miss."""

    def hit(self, origin: Origin, directions: Directions) -> Tensor:
        enter, leave = self.interval(origin, directions)
        first = torch.where(enter > 0, enter, leave)
        return first.masked_fill_((enter > leave) | (first <= 0), math.inf)


@dataclass(frozen=True)
class Ellipsoid(Convex):
    radii: Triple  # along x, y, z

    def extent(self) -> Triple:
        return self.radii

    def interval(self, origin: Origin, directions: Directions) -> Interval:
        # In the space where the ellipsoid is the unit sphere.
        o = [x / r for x, r in zip(origin, self.radii, strict=True)]
        d = [x / r for x, r in zip(directions, self.radii, strict=True)]
        return ball_interval(o, d, 1.0)

    def distance(self, points: Tensor) -> Tensor:
        """First-order distance: (|q| - 1) / |grad|, q in units of the semi-axes."""
        radii = points.new_tensor(self.radii)
        length = (points / radii).norm(dim=1)
        return (length - 1) * length / (points / radii**2).norm(dim=1).clamp(min=1e-12)

    def normal(self, points: Tensor) -> Tensor:
        return unit(points / points.new_tensor(self.radii) ** 2)


def ball(radius: float) -> Ellipsoid:
    return Ellipsoid((radius, radius, radius))


@dataclass(frozen=True)
class Cuboid(Convex):
    half: Triple  # sizes along x, y, z

    def extent(self) -> Triple:
        return self.half

    def interval(self, origin: Origin, directions: Directions) -> Interval:
        x, y, z = (slab(*axis) for axis in zip(origin, directions, self.half, strict=True))
        return overlap(overlap(x, y), z)

    def distance(self, points: Tensor) -> Tensor:
        return (points.abs() - points.new_tensor(self.half)).amax(1)

    def normal(self, points: Tensor) -> Tensor:
        axis = (points.abs() - points.new_tensor(self.half)).argmax(1, keepdim=True)
        return torch.zeros_like(points).scatter_(1, axis, points.gather(1, axis).sign())


@dataclass(frozen=True)
class Gable(Convex):
    """A prism along x, in y and z a triangle with its point up."""

    half: Triple  # sizes along x, y (at the foot) and z

    def extent(self) -> Triple:
        return self.half

    def interval(self, origin: Origin, directions: Directions) -> Interval:
        (x, y, z), (u, v, w) = origin, directions
        length, width, height = self.half
        kept = overlap(slab(x, u, length), slab(z, w, height))
        for side in (-2 * height, 2 * height):
            # The slopes are side * y + width * z = width * height.
            slope = below(side * y + width * z, side * v + width * w, width * height)
            kept = overlap(kept, slope)
        return kept

    def distance(self, points: Tensor) -> Tensor:
        return self._beyond(points).amax(1)

    def normal(self, points: Tensor) -> Tensor:
        """The normal of the nearest plane."""
        _, width, height = self.half
        signs, zero = points.sign(), torch.zeros(len(points)).to(points)
        slope = torch.stack((zero, 2 * height * signs[:, 1], zero + width), dim=1)
        end, foot = signs * points.new_tensor((1, 0, 0)), points.new_tensor((0, 0, -1))
        planes = torch.stack((end, foot.expand_as(end), unit(slope)), dim=1)
        nearest = self._beyond(points).argmax(1)
        return planes[torch.arange(len(points)), nearest]

    def _beyond(self, points: Tensor) -> Tensor:
        """How far points are beyond an end, the foot and a slope, [N, 3]."""
        length, width, height = self.half
        x, y, z = points.unbind(1)
        slope = (2 * height * y.abs() + width * (z - height)) / math.hypot(2 * height, width)
        return torch.stack((x.abs() - length, -z - height, slope), dim=1)


@dataclass(frozen=True)
class Cylinder(Convex):
    """A capped cylinder along z."""

    radius: float
    half: float

    def extent(self) -> Triple:
        return (self.radius, self.radius, self.half)

    def interval(self, origin: Origin, directions: Directions) -> Interval:
        wall = ball_interval(origin[:2], directions[:2], self.radius)
        return overlap(wall, slab(origin[2], directions[2], self.half))

    def distance(self, points: Tensor) -> Tensor:
        return torch.maximum(*self._beyond(points))

    def normal(self, points: Tensor) -> Tensor:
        """The normal of the wall or of a cap, whichever is nearer."""
        beyond_wall, beyond_cap = self._beyond(points)
        wall = unit(points * points.new_tensor((1, 1, 0)))
        cap = points.sign() * points.new_tensor((0, 0, 1))
        return torch.where((beyond_wall > beyond_cap)[:, None], wall, cap)

    def _beyond(self, points: Tensor) -> tuple[Tensor, Tensor]:
        return points[:, :2].norm(dim=1) - self.radius, points[:, 2].abs() - self.half


@dataclass(frozen=True)
class Capsule(Convex):
    """All points within `radius` of the segment from -half to half along z."""

    radius: float
    half: float

    def extent(self) -> Triple:
        return (self.radius, self.radius, self.half + self.radius)

    def interval(self, origin: Origin, directions: Directions) -> Interval:
        # The outermost ends of an open cylinder and two balls, because their union is convex.
        wall = ball_interval(origin[:2], directions[:2], self.radius)
        enter, leave = overlap(wall, slab(origin[2], directions[2], self.half))
        missed = enter > leave
        enter, leave = enter.masked_fill(missed, math.inf), leave.masked_fill(missed, -math.inf)
        for end in (-self.half, self.half):
            ball = ball_interval((origin[0], origin[1], origin[2] - end), directions, self.radius)
            enter, leave = torch.minimum(enter, ball[0]), torch.maximum(leave, ball[1])
        return enter, leave

    def distance(self, points: Tensor) -> Tensor:
        return self.from_axis(points).norm(dim=1) - self.radius

    def normal(self, points: Tensor) -> Tensor:
        return unit(self.from_axis(points))

    def from_axis(self, points: Tensor) -> Tensor:
        """Vectors from the nearest point of the segment."""
        x, y, z = points.unbind(1)
        return torch.stack((x, y, z - z.clamp(-self.half, self.half)), dim=1)


@dataclass(frozen=True)
class Shifted(Convex):
    """A convex shape moved by `offset`, as an operand of `Carved` or `Common`."""

    shape: Convex
    offset: Triple

    def extent(self) -> Triple:
        x, y, z = (abs(o) + e for o, e in zip(self.offset, self.shape.extent(), strict=True))
        return x, y, z

    def interval(self, origin: Origin, directions: Directions) -> Interval:
        x, y, z = (o - s for o, s in zip(origin, self.offset, strict=True))
        return self.shape.interval((x, y, z), directions)

    def distance(self, points: Tensor) -> Tensor:
        return self.shape.distance(points - points.new_tensor(self.offset))

    def normal(self, points: Tensor) -> Tensor:
        return self.shape.normal(points - points.new_tensor(self.offset))


@dataclass(frozen=True)
class Common(Convex):
    """The intersection of two convex shapes."""

    first: Convex
    second: Convex

    def extent(self) -> Triple:
        x, y, z = map(min, self.first.extent(), self.second.extent())
        return x, y, z

    def interval(self, origin: Origin, directions: Directions) -> Interval:
        return overlap(*(x.interval(origin, directions) for x in (self.first, self.second)))

    def distance(self, points: Tensor) -> Tensor:
        return torch.maximum(self.first.distance(points), self.second.distance(points))

    def normal(self, points: Tensor) -> Tensor:
        first = self.first.distance(points) > self.second.distance(points)
        return torch.where(first[:, None], self.first.normal(points), self.second.normal(points))


@dataclass(frozen=True)
class Carved(Shape):
    """A convex `body` minus the convex `bites`."""

    body: Convex
    bites: Sequence[Convex]

    def extent(self) -> Triple:
        return self.body.extent()

    def hit(self, origin: Origin, directions: Directions) -> Tensor:
        """The nearest end of any operand's interval that lies on the surface of the difference.

        An end of the body's interval lies on it if it is outside all bites; an end of a bite's
        interval, if it is inside the body and outside the other bites.
        """
        operands = [self.body, *self.bites]
        intervals = [operand.interval(origin, directions) for operand in operands]
        nearest = torch.full_like(intervals[0][0], math.inf)
        for own, (enter, leave) in enumerate(intervals):
            crossed = enter <= leave
            for t in (enter, leave):
                surface = crossed & (t > 0) & (t < nearest)
                for other, (a, b) in enumerate(intervals):
                    if other != own:
                        within = (a < t) & (t < b)
                        surface &= within if other == 0 else ~within
                nearest = torch.where(surface, t, nearest)
        return nearest

    def distance(self, points: Tensor) -> Tensor:
        bites = torch.stack([-bite.distance(points) for bite in self.bites])
        return torch.maximum(self.body.distance(points), bites.amax(0))

    def normal(self, points: Tensor) -> Tensor:
        """The normal of the operand whose surface a point lies on; for a bite, pointing into it."""
        nearest = self.body.distance(points).abs()
        normal = self.body.normal(points)
        for bite in self.bites:
            distance = bite.distance(points).abs()
            normal = torch.where((distance < nearest)[:, None], -bite.normal(points), normal)
            nearest = torch.minimum(distance, nearest)
        return normal


@dataclass(frozen=True)
class Pierced(Shape):
    """A box with a lattice of rectangular holes through it along y: a wall, a fence, a ladder.

    A ray that starts inside the solid is taken to leave it where it leaves the box.
    """

    half: Triple
    count: tuple[int, int]  # holes along x and along z, evenly spread
    hole: tuple[float, float]  # half sizes of a hole along x and z

    def extent(self) -> Triple:
        return self.half

    def hit(self, origin: Origin, directions: Directions) -> Tensor:
        """Where a ray enters the solid, or the side of the hole that it is in."""
        enter, leave = Cuboid(self.half).interval(origin, directions)
        start = enter.clamp(min=0)
        side = torch.full_like(leave, math.inf)
        inside = torch.ones_like(leave, dtype=torch.bool)
        for axis, count, hole in zip((0, 2), self.count, self.hole, strict=True):
            direction = directions[axis]
            x = start * direction + origin[axis]
            x -= centre_of_cell(x, self.half[axis], count)
            inside &= x.abs() < hole
            # Until the side ahead; a ray along the sides never gets there.
            room = hole - x * direction.sign()
            side = torch.minimum(side, room / direction.abs().clamp(min=1e-12))
        side += start
        side = torch.where(side < leave, side, math.inf)
        solid = torch.where(enter > 0, enter, leave)
        missed = (enter > leave) | (leave <= 0)
        return torch.where(inside, side, solid).masked_fill_(missed, math.inf)

    def distance(self, points: Tensor) -> Tensor:
        return torch.maximum(Cuboid(self.half).distance(points), -self._from_hole(points).amax(1))

    def normal(self, points: Tensor) -> Tensor:
        """The normal of the box or of the side of a hole, whichever is nearer."""
        beyond = self._from_hole(points)
        x, _, z = (points - self._middles(points)).unbind(1)
        zero = torch.zeros_like(x)
        across = (beyond[:, 0] > beyond[:, 1])[:, None]
        upright, level = torch.stack((-x, zero, zero), 1), torch.stack((zero, zero, -z), 1)
        sides = torch.where(across, upright, level).sign()
        box = Cuboid(self.half)
        on_box = box.distance(points).abs() < beyond.amax(1).abs()
        return torch.where(on_box[:, None], box.normal(points), sides)

    def _from_hole(self, points: Tensor) -> Tensor:
        """How far points are beyond the sides of the nearest hole, along x and z: [N, 2]."""
        return (points - self._middles(points)).abs()[:, ::2] - points.new_tensor(self.hole)

    def _middles(self, points: Tensor) -> Tensor:
        x, y, z = points.unbind(1)
        along_x = centre_of_cell(x, self.half[0], self.count[0])
        along_z = centre_of_cell(z, self.half[2], self.count[1])
        return torch.stack((along_x, torch.zeros_like(y), along_z), dim=1)


def centre_of_cell(x: Tensor, half: float, count: int) -> Tensor:
    """The middle of the cell that holds x, of `count` cells from -half to half."""
    size = 2 * half / count
    cell = ((x + half) / size).floor().clamp(0, count - 1)
    return (cell + 0.5) * size - half


def ball_interval(origin: Sequence, directions: Sequence[Tensor], radius: float) -> Interval:
    """Where rays are within `radius` of 0, in as many dimensions as there are components.

    Computed from the ray's nearest point to 0: with the textbook's b^2 - 4 a c, rounding loses a
    thin wire seen from afar. With a direction of length 0, all of the ray is its origin.
    """
    a = sum_of_products(directions, directions).clamp_(min=1e-30)
    middle = -sum_of_products(origin, directions) / a
    nearest = [torch.add(d * middle, o) for o, d in zip(origin, directions, strict=True)]
    gap = radius * radius - sum_of_products(nearest, nearest)
    reach = (gap.clamp(min=0) / a).sqrt_()
    enter, leave = middle - reach, middle + reach
    return enter.masked_fill_(gap < 0, math.inf), leave.masked_fill_(gap < 0, -math.inf)


def overlap(first: Interval, second: Interval) -> Interval:
    """The intersection of two intervals along each ray."""
    return torch.maximum(first[0], second[0]), torch.minimum(first[1], second[1])


def slab(origin: float | Tensor, direction: Tensor, half: float) -> Interval:
    """Where rays are within `half` of 0 along one axis."""
    # A ray parallel to the slab never leaves or never enters it; a tiny slope avoids 0 / 0.
    inverse = direction.masked_fill(direction.abs() < 1e-12, 1e-12).reciprocal_()
    low, high = (-half - origin) * inverse, (half - origin) * inverse
    return torch.minimum(low, high), torch.maximum(low, high)


def below(origin: float | Tensor, direction: Tensor, limit: float) -> Interval:
    """Where a coordinate is at most `limit`, which starts at `origin` and grows by `direction`."""
    slope = direction.masked_fill(direction.abs() < 1e-12, 1e-12)
    crossing = (limit - origin) / slope
    enter = torch.where(slope < 0, crossing, -math.inf)
    return enter, torch.where(slope > 0, crossing, math.inf)


def sum_of_products(first: Sequence, second: Sequence) -> Tensor:
    """Dot product of vectors given as components."""
    return sum((a * b for a, b in zip(first[1:], second[1:], strict=True)), first[0] * second[0])


def box_corners(half: Triple) -> Tensor:
    """Corners [8, 3] of a centred box with half sizes `half`."""
    return torch.cartesian_prod(*(torch.tensor((-1.0, 1.0)),) * 3) * torch.tensor(half)


def unit(vectors: Tensor) -> Tensor:
    """[N, 3] scaled to length 1; a zero vector stays zero."""
    return torch.nn.functional.normalize(vectors, dim=1)

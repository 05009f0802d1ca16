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

from bench.types import SomeTensors, ThreeTensors, TwoTensors

Triple = tuple[float, float, float]
Origin = tuple[Any, Any, Any]  # floats or tensors
Directions = ThreeTensors
Interval = TwoTensors


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

    def _beyond(self, points: Tensor) -> TwoTensors:
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


def ball_interval(origin: Sequence, directions: SomeTensors, radius: float) -> Interval:
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


def sum_of_products(first: Sequence, second: Sequence) -> Tensor:
    """Dot product of vectors given as components."""
    return sum((a * b for a, b in zip(first[1:], second[1:], strict=True)), first[0] * second[0])


def box_corners(half: Triple) -> Tensor:
    """Corners [8, 3] of a centred box with half sizes `half`."""
    return torch.cartesian_prod(*(torch.tensor((-1.0, 1.0)),) * 3) * torch.tensor(half)


def unit(vectors: Tensor) -> Tensor:
    """[N, 3] scaled to length 1; a zero vector stays zero."""
    return torch.nn.functional.normalize(vectors, dim=1)

"""Renders exact pictures of analytic models: every sub-pixel ray is solved in closed form.

A model is made of opaque solids under one fixed light, or of overlapping homogeneous media. A
picture is rendered in bands of rows. In each band, a part of a model is traced only in the columns
that its bounding box can cover.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from bench.cameras import project
from bench.scenes.embedded.solids import Carved, Shape, Triple, ball_interval, box_corners, unit
from bench.scenes.embedded.textures import Colour, Texture
from bench.types import EMPTY_ALPHA, Camera, Frame, ThreeTensors

BAND_RAYS = 1 << 18  # enough to hide the cost of calls, few enough to stay in the cache

Span = tuple[int, int, int]
"""A part's number, the first column that it can cover in a band, and one past the last."""

LIGHT = (0.48, -0.6, 0.64)  # unit direction to the light
LIFT = 1e-4  # distance of a shadow ray's start above the surface, in the model's units

SKY, GROUND, SUN = 0.52, 0.24, 0.62
"""Light from above, from below, and from the light's direction, as shares of a surface's colour."""

SHARPNESS = 60.0  # exponent of highlights


@dataclass(frozen=True)
class Band:
    """The rays of some rows of a picture, from `origin` [3] along `rotation` @ (x, y, 1)."""

    origin: Tensor
    rotation: Tensor
    x: Tensor  # [1, W, S] on the image plane
    y: Tensor  # [rows, 1, S]

    @property
    def shape(self) -> tuple[int, ...]:
        """Of a number for each ray."""
        return self.y.shape[0], *self.x.shape[1:]

    def directions(self, frame: Tensor, columns: slice) -> ThreeTensors:
        """Directions of the rays in `columns`, as components along the axes of `frame` [3, 3]."""
        matrix = (frame.T @ self.rotation).tolist()
        x = self.x[:, columns]
        across, down, ahead = ([row[i] for row in matrix] for i in range(3))
        u, v, w = ((x * across[i] + ahead[i]) + self.y * down[i] for i in range(3))
        return u, v, w


class SceneModel(Protocol):
    """A model made of parts, through which a band of rays can be traced."""

    def boxes(self) -> Tensor:
        """Corners of a box around each part, [P, 8, 3]."""

    def trace(self, band: Band, spans: Sequence[Span]) -> ThreeTensors:
        """What the rays [rows, W, S] see of the parts in `spans`: rgb and depth, premultiplied by
        alpha, which comes between them. A part is never seen outside its span."""


def render(model: SceneModel, camera: Camera, samples: int) -> Frame:
    """Render `model` on black, averaged over `samples` rays per pixel (a power of two).

    `camera` is in the model's units. A pixel's alpha and rgb are means over its rays, depth the
    mean z-depth weighted by opacity (+inf where alpha is below EMPTY_ALPHA). A single sample is at
    the centre.
    """
    width, height = camera.size
    offsets = sample_offsets(samples)
    x = (torch.arange(width)[:, None] + offsets[:, 0] - camera.cx) / camera.fx
    y = (torch.arange(height)[:, None] + offsets[:, 1] - camera.cy) / camera.fy
    rgb = torch.zeros(height, width, 3)
    alpha, depth = torch.zeros(2, height, width)
    rows = max(BAND_RAYS // (width * samples), 1)
    seen_in = windows(camera, model.boxes())
    for top in range(0, height, rows):
        bottom = min(top + rows, height)
        spans = [
            (part, left, right)
            for part, (left, first, right, last) in enumerate(seen_in)
            if left < right and first < bottom and last > top
        ]
        if not spans:
            continue
        band = Band(camera.centre, camera.rotation, x[None], y[top:bottom, None])
        for picture, seen in zip((rgb, alpha, depth), model.trace(band, spans), strict=True):
            picture[top:bottom] = seen.mean(2)
    depth = (depth / alpha.clamp(min=EMPTY_ALPHA)).masked_fill(alpha < EMPTY_ALPHA, math.inf)
    return Frame(rgb, depth, alpha)


def sample_offsets(samples: int) -> Tensor:
    """Hammersley points [samples, 2] in a pixel, one in each of `samples` rows and columns."""
    bits = samples.bit_length() - 1
    index, mirrored = torch.arange(samples), torch.zeros(samples, dtype=torch.int64)
    for bit in range(bits):
        mirrored |= ((index >> bit) & 1) << (bits - 1 - bit)
    return (torch.stack((index, mirrored), dim=1) + 0.5) / samples


def windows(camera: Camera, boxes: Tensor) -> list[list[int]]:
    """The first and last column and row, exclusive, in which a camera may see each of `boxes`."""
    pixels, depth = project(camera, boxes)
    ahead, size = depth > 0, pixels.new_tensor(camera.size)
    low, high = pixels.amin(1).floor() - 1, pixels.amax(1).ceil() + 1
    # A part that reaches behind the camera may be visible anywhere.
    whole = ahead.all(1, keepdim=True)
    low, high = low.where(whole, 0).clamp(min=0), high.where(whole, size).minimum(size)
    high = high.where(ahead.any(1, keepdim=True), 0)
    return torch.cat((low, high), dim=1).int().tolist()


@dataclass(frozen=True)
class Part:
    """A solid placed in a model, with the texture of its own frame."""

    shape: Shape
    texture: Texture
    centre: Triple = (0.0, 0.0, 0.0)  # origin of the frame, in the model's units
    turn: Triple = (0.0, 0.0, 0.0)  # in degrees about x, then y, then z
    gloss: float = 0.0  # strength of the highlight, 0 for a matt surface
    frame: Tensor = field(init=False)

    def __post_init__(self) -> None:
        turned = Rotation.from_euler("xyz", self.turn, degrees=True).as_matrix()
        object.__setattr__(self, "frame", torch.from_numpy(turned).float())


class Solids:
    """A model of opaque parts, lit by a point at infinity: shadows are hard and exact."""

    def __init__(self, parts: Sequence[Part]) -> None:
        self.parts = parts
        self.light = light = torch.tensor(LIGHT)
        across = unit(torch.linalg.cross(light, torch.tensor((0.0, 0.0, 1.0)))[None])[0]
        self.light_axes = torch.stack((across, torch.linalg.cross(light, across), light), dim=1)
        self.corners = self.boxes()
        boxes = self.corners @ self.light_axes
        self.low, self.high = boxes.amin(1), boxes.amax(1)

    def boxes(self) -> Tensor:
        placed = ((box_corners(p.shape.extent()) @ p.frame.T, p.centre) for p in self.parts)
        return torch.stack([corners + torch.tensor(centre) for corners, centre in placed])

    def trace(self, band: Band, spans: Sequence[Span]) -> ThreeTensors:
        """Find the nearest surface over all parts, then shade only that."""
        shape = band.shape
        depth = band.x.new_full(shape, math.inf)
        owner = torch.full(shape, -1, dtype=torch.int16)
        # From front to back, so that a part whose box lies behind all that was met can be left out.
        ahead = ((self.corners - band.origin) @ band.rotation[:, 2]).amin(1).tolist()
        for number, first, last in sorted(spans, key=lambda span: ahead[span[0]]):
            part, columns = self.parts[number], slice(first, last)
            if ahead[number] > depth[:, columns].amax():
                continue
            x, y, z = ((band.origin - torch.tensor(part.centre)) @ part.frame).tolist()
            t = part.shape.hit((x, y, z), band.directions(part.frame, columns))
            nearest = depth[:, columns]
            owner[:, columns].masked_fill_(t < nearest, number)
            torch.minimum(nearest, t, out=nearest)
        seen = owner >= 0
        rays = seen.nonzero(as_tuple=True)
        order = owner[rays].argsort(stable=True)
        row, column, sample = rays = tuple(index[order] for index in rays)
        x, y = band.x[0, column, sample], band.y[row, 0, sample]
        plane = torch.stack((x, y, torch.ones_like(x)), dim=1)
        rgb = depth.new_zeros(*shape, 3)
        rgb[rays] = self.shade(owner[rays], depth[rays], plane, band)
        return rgb, seen.to(depth.dtype), depth.masked_fill_(~seen, 0)

    def shade(self, owners: Tensor, depth: Tensor, plane: Tensor, band: Band) -> Tensor:
        """Lambert and Blinn-Phong colours [N, 3] of what rays of a `band` through points (x, y, 1)
        of the image `plane` meet at `depth` [N], of the parts `owners` [N], which are sorted."""
        numbers, counts = owners.unique_consecutive(return_counts=True)
        ends = [0, *counts.cumsum(0).tolist()]
        parts = [self.parts[number] for number in numbers.tolist()]
        pieces = list(zip(parts, map(slice, ends, ends[1:]), strict=True))
        directions, points, local, normals, colours = torch.empty(5, *plane.shape)
        for part, piece in pieces:
            directions[piece] = plane[piece] @ band.rotation.T
            points[piece] = band.origin + depth[piece, None] * directions[piece]
            local[piece] = (points[piece] - torch.tensor(part.centre)) @ part.frame
            normals[piece] = part.shape.normal(local[piece]) @ part.frame.T
        # The normal points to the viewer's side of the surface.
        away = (normals * directions).sum(1, keepdim=True) > 0
        normals = torch.where(away, -normals, normals)
        lit = normals @ self.light > 0
        lit[lit.clone()] = ~self.shadowed(owners[lit], (points + LIFT * normals)[lit])
        height = 0.5 + 0.5 * normals[:, 2:]
        sun = (normals * self.light).sum(1, keepdim=True) * lit[:, None]
        light = GROUND + (SKY - GROUND) * height + SUN * sun
        half = unit(self.light - unit(directions))
        highlight = (normals * half).sum(1, keepdim=True).clamp(min=0)
        for part, piece in pieces:
            colours[piece] = part.texture(local[piece]) * light[piece]
            if part.gloss:
                colours[piece] += part.gloss * highlight[piece] ** SHARPNESS * lit[piece, None]
        return colours.clamp(max=1)

    def shadowed(self, owners: Tensor, points: Tensor) -> Tensor:
        """[N] bool: whether another part is between a point of part `owners` [N] and the light.

        A convex part is skipped for itself: it casts no shadow on its own lit side.
        """
        dark = torch.zeros(len(points), dtype=torch.bool)
        seen = points @ self.light_axes
        # Sorted by their first coordinate: under a caster's box are only points of one piece.
        order = seen[:, 0].argsort()
        across, along, ahead = seen[order].T.contiguous()
        columns, owners = points[order].T.contiguous(), owners[order]
        first = torch.searchsorted(across, self.low[:, 0].contiguous()).tolist()
        last = torch.searchsorted(across, self.high[:, 0].contiguous(), right=True).tolist()
        boxes = zip(first, last, self.low.tolist(), self.high.tolist(), strict=True)
        for number, (start, end, (_, low, _), (_, high, nearest)) in enumerate(boxes):
            piece, caster = slice(start, end), self.parts[number]
            under = (along[piece] >= low) & (along[piece] <= high) & (ahead[piece] <= nearest)
            under &= ~dark[piece]
            under = start + under.nonzero()[:, 0]
            if not len(under):
                continue
            below = columns[:, under] - torch.tensor(caster.centre)[:, None]
            x, y, z = (caster.frame.T @ below if any(caster.turn) else below).unbind(0)
            u, v, w = (self.light @ caster.frame).unbind(0)
            found = caster.shape.hit((x, y, z), (u, v, w)) < math.inf
            if not isinstance(caster.shape, Carved):
                found &= owners[under] != number
            dark[under[found]] = True
        return torch.empty_like(dark).index_put_((order,), dark)


@dataclass(frozen=True)
class Ball:
    """A sphere of constant density (sigma, 1 / unit length) that glows in one colour."""

    centre: Triple
    radius: float
    density: float
    colour: Colour


@dataclass(frozen=True)
class Media:
    """Balls whose densities add where they overlap; their colours are averaged, density-weighted.

    Between two crossings of surfaces the density k (per unit of t) and the colour c are constant.
    With transmittance T at the start of such a piece [a, b]

        opacity += T (1 - e^-x),    rgb += T (1 - e^-x) c,    x = k (b - a),
        depth   += T ((1 - e^-x) a + (1 - e^-x - x e^-x) / k),

    where the last line is the integral of t k e^(-k (t - a)).
    """

    balls: Sequence[Ball]

    def boxes(self) -> Tensor:
        balls = self.balls
        return torch.stack([torch.tensor(b.centre) + box_corners((b.radius,) * 3) for b in balls])

    def trace(self, band: Band, spans: Sequence[Span]) -> ThreeTensors:
        """Integrate all balls in `spans` together, for the rays that hit any of them."""
        shape = band.shape
        balls = [self.balls[number] for number, _, _ in spans]
        directions = band.directions(torch.eye(3), slice(None))
        enter, leave = band.x.new_zeros(2, len(balls), *shape)
        for k, ((_, first, last), ball) in enumerate(zip(spans, balls, strict=True)):
            columns = slice(first, last)
            origin = (band.origin - torch.tensor(ball.centre)).tolist()
            a, b = ball_interval(origin, [d[:, columns] for d in directions], ball.radius)
            missed = (a > b) | (b <= 0)
            enter[k, :, columns] = a.clamp_(min=0).masked_fill_(missed, 0)
            leave[k, :, columns] = b.masked_fill_(missed, 0)
        met = (leave > 0).any(0)
        speed = torch.stack([d[met] for d in directions]).norm(dim=0)  # length per unit of t
        density = speed.new_tensor([ball.density for ball in balls])
        colour = speed.new_tensor([ball.colour for ball in balls])
        seen = integrate(enter[:, met], leave[:, met], speed, density, colour)
        rgb, (alpha, depth) = speed.new_zeros(*shape, 3), speed.new_zeros(2, *shape)
        rgb[met], alpha[met], depth[met] = seen
        return rgb, alpha, depth


def integrate(
    enter: Tensor, leave: Tensor, speed: Tensor, density: Tensor, colour: Tensor
) -> ThreeTensors:
    """rgb [N, 3], opacity [N] and depth times opacity [N] of rays through B overlapping media.

    `enter` and `leave` [B, N] are the interval of each medium along each ray, equal where the ray
    misses it; `speed` [N] the length of a ray's direction; `density` [B], `colour` [B, 3].
    """
    ends, order = torch.cat((enter, leave)).sort(dim=0)  # [2B, N]
    step = torch.cat((density, -density))
    emission = torch.cat((density[:, None] * colour, -density[:, None] * colour))
    k, alpha, depth = speed.new_zeros(3, len(speed))
    glow, rgb = speed.new_zeros(2, len(speed), 3)
    transmittance = torch.ones_like(k)
    for piece in range(len(ends) - 1):
        k = k + step[order[piece]]
        glow = glow + emission[order[piece]]
        # Outside all media k is only rounding error, far below the density of the thinnest medium.
        outside = ~(k > 1e-3 * density.min())
        rate = (k * speed).masked_fill(outside, 1)
        x = (rate * (ends[piece + 1] - ends[piece])).masked_fill(outside, 0)
        passed, absorbed = torch.exp(-x), -torch.expm1(-x)
        weight = transmittance * absorbed
        rgb = rgb + (weight / k.masked_fill(outside, 1))[:, None] * glow
        alpha = alpha + weight
        depth = depth + weight * ends[piece] + transmittance * (absorbed - x * passed) / rate
        transmittance = transmittance * passed
    return rgb, alpha, depth

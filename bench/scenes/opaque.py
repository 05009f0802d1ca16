"""Models of opaque solids under one fixed light."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from bench.scenes.raytrace import Band, Span, Traced
from bench.scenes.solids import Carved, Shape, box_corners, unit
from bench.scenes.textures import Texture

LIGHT = (0.48, -0.6, 0.64)
"""Unit direction to the light."""

LIFT = 1e-4
"""Distance of a shadow ray's start above the surface, in the model's units."""

SKY, GROUND, SUN = 0.52, 0.24, 0.62
"""Light from above, from below, and from the light's direction, as shares of a surface's colour."""


@dataclass(frozen=True)
class Part:
    """A solid placed in a model.

    Attributes:
        shape: the solid, in its own frame.
        texture: colour at points of this frame.
        centre: origin of the frame, in the model's units.
        turn: rotation in degrees about x, then y, then z.
        gloss: strength of the highlight, 0 for a matt surface.
        sharpness: exponent of the highlight.
    """

    shape: Shape
    texture: Texture
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0)
    gloss: float = 0.0
    sharpness: float = 60.0
    frame: Tensor = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "frame", rotation(*self.turn))

    def box(self) -> Tensor:
        """Corners of a box around the part, [8, 3]."""
        return box_corners(self.shape.extent()) @ self.frame.T + torch.tensor(self.centre)


class Solids:
    """A model of opaque parts, lit by a point at infinity: shadows are hard and exact."""

    def __init__(self, parts: Sequence[Part]) -> None:
        self.parts = parts
        light = torch.tensor(LIGHT)
        across = unit(torch.linalg.cross(light, torch.tensor((0.0, 0.0, 1.0)))[None])[0]
        self.light_axes = torch.stack((across, torch.linalg.cross(light, across), light), dim=1)
        boxes = self.boxes() @ self.light_axes
        self.low, self.high = boxes.amin(1), boxes.amax(1)

    def boxes(self) -> Tensor:
        return torch.stack([part.box() for part in self.parts])

    def trace(self, band: Band, spans: Sequence[Span]) -> Traced:
        """Find the nearest surface over all parts, then shade only that."""
        shape = (band.y.shape[0], *band.x.shape[1:])
        depth = band.x.new_full(shape, math.inf)
        owner = torch.full(shape, -1, dtype=torch.int16, device=depth.device)
        for number, first, last in spans:
            part, columns = self.parts[number], slice(first, last)
            frame = part.frame.to(depth)
            x, y, z = ((band.origin - depth.new_tensor(part.centre)) @ frame).tolist()
            t = part.shape.hit((x, y, z), band.directions(frame, columns))
            nearest = depth[:, columns]
            owner[:, columns].masked_fill_(t < nearest, number)
            torch.minimum(nearest, t, out=nearest)
        seen = owner >= 0
        rgb = depth.new_zeros(*shape, 3)
        for number, first, last in spans:
            rays = (owner[:, first:last] == number).nonzero(as_tuple=True)
            if len(rays[0]):
                row, column, sample = rays[0], rays[1] + first, rays[2]
                x, y = band.x[0, column, sample], band.y[row, 0, sample]
                directions = torch.stack((x, y, torch.ones_like(x)), 1) @ band.rotation.T
                points = band.origin + depth[row, column, sample, None] * directions
                rgb[row, column, sample] = self.shade(number, points, directions)
        return Traced(rgb, seen.to(depth.dtype), depth.masked_fill_(~seen, 0))

    def shade(self, number: int, points: Tensor, directions: Tensor) -> Tensor:
        """Lambert and Blinn-Phong colours [N, 3] of a part's `points`, seen along `directions`."""
        part = self.parts[number]
        frame, light = part.frame.to(points), points.new_tensor(LIGHT)
        local = (points - points.new_tensor(part.centre)) @ frame
        normals = part.shape.normal(local) @ frame.T
        toward = -unit(directions)
        # The normal points to the viewer's side of the surface.
        facing = (normals * toward).sum(1, keepdim=True)
        normals = torch.where(facing < 0, -normals, normals)
        height = 0.5 + 0.5 * normals[:, 2:]
        sun = (normals * light).sum(1, keepdim=True)
        lit = sun[:, 0] > 0
        lit[lit.clone()] = ~self.shadowed(number, (points + LIFT * normals)[lit])
        sun = sun * lit[:, None]
        colour = part.texture(local) * (GROUND + (SKY - GROUND) * height + SUN * sun)
        if part.gloss:
            half = unit(toward + light)
            highlight = (normals * half).sum(1, keepdim=True).clamp(min=0) ** part.sharpness
            colour = colour + part.gloss * highlight * lit[:, None]
        return colour.clamp(max=1)

    def shadowed(self, number: int, points: Tensor) -> Tensor:
        """[N] bool: whether another part is between these points of part `number` and the light."""
        dark = torch.zeros(len(points), dtype=torch.bool, device=points.device)
        light, columns = points.new_tensor(LIGHT), points.T.contiguous()
        for caster in (self.parts[k] for k in self.casters(number, points)):
            frame = caster.frame.to(points)
            centre = points.new_tensor(caster.centre)[:, None]
            x, y, z = (frame.T @ (columns - centre)).unbind(0)
            u, v, w = (light @ frame).unbind(0)
            dark |= caster.shape.hit((x, y, z), (u, v, w)) < math.inf
        return dark

    def casters(self, number: int, points: Tensor) -> list[int]:
        """The parts that may lie between these points of part `number` and the light.

        Seen from the light, their box overlaps the box of the points and reaches nearer. A convex
        part is skipped for itself: it casts no shadow on its own lit side.
        """
        if not len(points):
            return []
        seen = (points @ self.light_axes.to(points)).cpu()
        low, high = seen.amin(0), seen.amax(0)
        candidates = (self.low < high)[:, :2].all(1) & (self.high > low).all(1)
        candidates[number] = isinstance(self.parts[number].shape, Carved)
        return candidates.nonzero()[:, 0].tolist()


def rotation(x: float, y: float, z: float) -> Tensor:
    """[3, 3] rotation by degrees about x, then y, then z."""
    turns = torch.eye(3, dtype=torch.float64)
    for axis, degrees in enumerate((x, y, z)):
        c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
        turn = torch.eye(3, dtype=torch.float64)
        a, b = (axis + 1) % 3, (axis + 2) % 3
        turn[a, a], turn[a, b], turn[b, a], turn[b, b] = c, -s, s, c
        turns = turn @ turns
    return turns.float()

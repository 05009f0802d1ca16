"""All of space in the unit cube: a contraction, and the steps of a ray from a camera to infinity.

A point x of the scene is q = 4 (x - 1/2) in half sides of the box, which fills the middle half of
the cube. With n its largest component, q stays where it is up to n = 1, and beyond it goes to
(2 - 1/n) q/n, which fills the rest of the cube: Barron et al. 2022 (mip-NeRF 360, Eq. 10), with
the maximum norm, as nerfstudio has it.

A ray is closest to the middle of the box at t_m, at a distance whose larger one with a half side is
b. Its steps are equal in v, the same contraction of r = (t - t_m) norm(d) / b on a line: v is r up
to 1 and 2 - 1/r beyond. They are so about as long as the cells there, and at most 1 / step.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from bench.types import Rays

HALF = 0.25  # half the side of the box, scene units

BEYOND = 1e-6  # of 2 - v: nearer than the end of every ray


def contract(points: Tensor) -> Tensor:
    """Where `points` [..., 3] of the scene are in the cube."""
    q = (points - 0.5) * 4
    inverse = 1 / q.abs().amax(dim=-1, keepdim=True)
    shrunk = torch.where(inverse < 1, (2 - inverse) * inverse, 1)
    return q * shrunk * 0.25 + 0.5


def expand(places: Tensor) -> Tensor:
    """The points of the scene that are at `places` [..., 3] inside the cube; inverts `contract`."""
    q = (places - 0.5) * 4
    size = q.abs().amax(dim=-1, keepdim=True)
    return torch.where(size > 1, q / (size * (2 - size)), q) * 0.25 + 0.5


def stretch(places: Tensor) -> Tensor:
    """Length along the radius, at least 1, that a unit of length at `places` [..., 3] in the cube
    stands for: n^2."""
    size = ((places - 0.5) * 4).abs().amax(dim=-1)
    return (2 - size).clamp(max=1) ** -2


@dataclass(frozen=True)
class Course:
    """Where along R rays their steps are, [R] float32 each."""

    middle: Tensor  # t_m
    reach: Tensor  # b / norm(d)
    first: Tensor  # v at t = 0
    length: Tensor  # of a step at v = 0, scene units
    end: Tensor  # t of half a step before infinity
    width: float  # of a step, in v

    @classmethod
    def of(cls, rays: Rays, step: float) -> "Course":
        """Rounded from float64, so that all backends have the same numbers."""
        origins, directions = rays.origins.double() - 0.5, rays.directions.double()
        square = directions.square().sum(dim=1)
        middle = -(origins * directions).sum(dim=1) / square
        apart = (origins + middle[:, None] * directions).norm(dim=1).clamp(min=HALF)
        reach = apart / square.sqrt()
        past = -middle / reach
        first = torch.where(past.abs() <= 1, past, past.sign() * (2 - 1 / past.abs()))
        width = torch.tensor(step, dtype=torch.float32).item() / HALF  # a GPU is given a float32
        numbers = middle, reach, first, width * apart, middle + 2 / width * reach
        middle, reach, first, length, end = (x.to(rays.origins.dtype) for x in numbers)
        return cls(middle, reach, first, length, end, width)

    def at(self, ray: Tensor, k: Tensor) -> Tensor:
        """t of the steps `k`, with their phases, of the rays `ray`."""
        v = self.first[ray] + k * self.width
        size = v.abs()
        size = torch.where(size <= 1, size, 1 / (2 - size).clamp(min=BEYOND))
        return self.middle[ray] + self.reach[ray] * torch.where(v < 0, -size, size)

    def lengths(self, ray: Tensor, t: Tensor) -> Tensor:
        """Lengths of the steps of the rays `ray` that are at `t`, scene units."""
        r = (t - self.middle[ray]) / self.reach[ray]
        return self.length[ray] * (r * r).clamp(min=1)

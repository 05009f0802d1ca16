"""Models of overlapping homogeneous media: the volume integral in closed form."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from bench.scenes.raytrace import Band, Span, Traced
from bench.scenes.solids import ball_interval, box_corners


@dataclass(frozen=True)
class Ball:
    """A sphere of constant density (sigma, 1 / unit length) that glows in one colour."""

    centre: tuple[float, float, float]
    radius: float
    density: float
    colour: tuple[float, float, float]


@dataclass(frozen=True)
class Cloud:
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

    def trace(self, band: Band, spans: Sequence[Span]) -> Traced:
        """Integrate all balls in `spans` together, for the rays that hit any of them."""
        shape = (band.y.shape[0], *band.x.shape[1:])
        balls = [self.balls[number] for number, _, _ in spans]
        directions = band.directions(torch.eye(3, device=band.x.device), slice(None))
        enter, leave = band.x.new_zeros(2, len(balls), *shape)
        for k, ((_, first, last), ball) in enumerate(zip(spans, balls, strict=True)):
            columns = slice(first, last)
            origin = (band.origin - torch.tensor(ball.centre).to(band.origin)).tolist()
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
        return Traced(rgb, alpha, depth)


def integrate(
    enter: Tensor, leave: Tensor, speed: Tensor, density: Tensor, colour: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """rgb [N, 3], opacity [N] and depth times opacity [N] of rays through B overlapping media.

    Args:
        enter, leave: [B, N] interval of each medium along each ray; equal where the ray misses it.
        speed: [N] length of a ray's direction.
        density, colour: [B] and [B, 3] of the media.
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

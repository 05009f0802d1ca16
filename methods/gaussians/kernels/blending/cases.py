"""Cases of the blending of Gaussians: agreement of the backends, and results known in advance."""

from typing import Any

import torch
from torch import Tensor

from bench.cameras import pixel_grid
from bench.case import (
    U32,
    Bound,
    Cases,
    Given,
    Operation,
    Property,
    Random,
    largest_error,
    on_backends,
    placed,
)
from methods.gaussians.kernels.blending import LARGEST_ALPHA, blend
from methods.gaussians.kernels.projection import LEAST_ALPHA, Ellipses
from methods.kernels.composite import STOP
from methods.kernels.dispatch import served

CLEAR = 1e-4
"""Minimum relative distance of every opacity, at every pixel, from a threshold of a comparison."""

CROWD = 600  # Gaussians at a pixel of the cases, at most


def _pixels(
    centres: Tensor, conics: Tensor, depth: Tensor, extents: Tensor, **rest: Any
) -> tuple[Tensor, ...]:
    return blend(Ellipses(centres, conics, depth, extents), **rest).columns


WHY = (
    "weights of at most 1 in all, each a product of n factors of 20 roundings, if n Gaussians are "
    "at a pixel, at most 600: 20 n u; what is behind the stop adds less than it"
)
LIGHT = Bound(WHY, lambda given: 20 * min(len(given["opacities"]), CROWD) * U32 + given["stop"])
BLEND = Operation(
    "gaussian blending",
    served(__package__),
    _pixels,
    {
        "values": LIGHT,
        "depth sums": Bound(f"depths are below 2; {WHY}", lambda given: 2 * LIGHT.of(given)),
        "opacities": LIGHT,
    },
    dict.fromkeys(
        ("centres", "conics", "opacities", "colours"),
        Bound(
            "relative to the largest gradient of its kind; its terms, together at most some ten "
            "times as large, are off as the weights are, or behind the stop: 10 (20 n u + stop)",
            lambda given: 10 * LIGHT.of(given),
        ),
    ),
    relative=True,
)
SIZES = {
    "one pixel": (30, 1, 1, 1),
    "no Gaussian": (0, 20, 10, 1),
    "one tile": (60, 16, 16, 1),
    "parts of tiles": (200, 67, 45, 1),
    "of many tiles": (10, 67, 45, 10),
    "crowded": (600, 21, 19, 1),
    "160 x 160": (2000, 160, 160, 1),
}
"""Number of Gaussians, width and height of the picture, factor on the size of the Gaussians."""


def cases() -> Cases:
    """No, some and crowded Gaussians; a plain loop; stop."""
    found = BLEND.cases("crowded, to a stop", draw, *SIZES["crowded"], STOP)
    for name, size in SIZES.items():
        found += BLEND.cases(name, draw, *size, items=size[0])

    loop = Property(
        BLEND.subject,
        "the picture and its slopes in the colours are those of a plain loop",
        "as in the agreement of the backends, of 60: 1,200 u",
        on_backends(1200, "fp64"),
    )
    return [*found, loop.case("13 x 9", _loop_error)]


def draw(count: int, width: int, height: int, size: int = 1, stop: float = 0.0) -> Given:
    """Gaussians in and around a picture, one to six pixels wide, or `size` times as wide; without
    those whose opacity at some pixel is close to a cut-off, where rounding would decide."""
    rand = Random(count + width).share
    centres = (rand(count, 2) * 1.4 - 0.2) * torch.tensor((width, height))
    variances = size**2 * (0.3 + 4 * rand(count, 2))
    tilt = (1.6 * rand(count) - 0.8) * variances.prod(dim=1).sqrt()
    area = variances.prod(dim=1) - tilt**2
    conics = torch.stack((variances[:, 1], -tilt, variances[:, 0]), dim=1) / area[:, None]
    opacities = 0.9 * rand(count)
    reach = 2 * (opacities / LEAST_ALPHA).clamp(min=1).log()
    drawn: dict[str, Any] = {
        "centres": centres,
        "conics": conics,
        "depth": 1 + rand(count),
        "extents": (reach[:, None] * variances).sqrt(),
        "opacities": opacities,
    }
    near = torch.zeros(count, dtype=torch.bool)
    for part in torch.arange(count).split(100):
        alpha = _alphas({name: x[part] for name, x in drawn.items()}, width, height)
        near[part] = ((alpha / LEAST_ALPHA - 1).abs() < CLEAR).any(dim=0)
    drawn = {name: x[~near] for name, x in drawn.items()}
    drawn["colours"] = rand(len(drawn["depth"]), 3)
    return drawn | {"width": width, "height": height, "stop": stop}


def _alphas(given: Given, width: int, height: int) -> Tensor:
    """Opacity [P, N] of each Gaussian at each pixel, in float64, without cut-offs."""
    offset = pixel_grid(width, height).double()[:, None] - given["centres"].double()
    a, b, c = given["conics"].double().unbind(dim=1)
    x, y = offset.unbind(dim=2)
    return given["opacities"].double() * (-(a * x * x + 2 * b * x * y + c * y * y) / 2).exp()


def _loop_error(backend: str, device: str, precision: str) -> float:
    """Of pixels, and of their slopes in the colours: weights, which are 0 behind the stop."""
    width = 13
    height = 9
    given = draw(60, width, height, stop=0.3)
    given["opacities"][0] = 1.0  # its alpha is cut
    depth = given["depth"]
    shares = torch.zeros(width * height, 60, dtype=torch.float64)
    for row, weights in zip(_alphas(given, width, height).tolist(), shares, strict=True):
        light = 1.0
        for i in depth.argsort().tolist():
            if light > given["stop"] and row[i] >= LEAST_ALPHA:
                weights[i] = light * min(row[i], LARGEST_ALPHA)
                light -= weights[i].item()
    weights = shares[:, : len(depth)]
    there = placed(given, device, precision)
    there["colours"].requires_grad_()
    got = _pixels(**there, backend=backend)
    (slope,) = torch.autograd.grad(got[0].mean(dim=0).sum(), there["colours"])
    colours = weights @ given["colours"].double()
    z = weights @ depth.double()
    want = colours, z, weights.sum(dim=1), weights.mean(dim=0)[:, None].expand(-1, 3)
    return largest_error((*got, slope), want)

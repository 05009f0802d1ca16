"""The splatting against a plain loop over the points."""

import math

import pytest
import torch
from torch import Tensor

from methods.steernerf.splat import splat
from tests.common import refusal, seeded


def scatter_points(count: int, width: int, height: int) -> tuple[Tensor, Tensor]:
    """Points inside and around the picture; many share a depth, some a u or a v, some are equal."""
    generator = seeded(count)
    size = torch.tensor([width, height])
    pixels = (torch.rand(count, 2, generator=generator) * 1.5 - 0.25) * size
    depth = (4 * torch.rand(count, generator=generator)).round() - 1
    return (4 * pixels).round() / 4, depth


def plain_splat(pixels: Tensor, depth: Tensor, width: int, height: int) -> list[int]:
    """The definition, a point at a time, in Python numbers."""
    shown: dict[int, int] = {}
    for i, ((u, v), z) in enumerate(zip(pixels.tolist(), depth.tolist(), strict=True)):
        inside = 0 <= u < width and 0 <= v < height  # neither of them if not finite
        if inside and math.isfinite(z) and z > 0:
            shown[math.floor(v) * width + math.floor(u)] = i
    of_points = {i: pixel for pixel, i in shown.items()}
    return [of_points.get(i, width * height) for i in range(len(depth))]


@pytest.mark.parametrize(
    ("count", "width", "height"),
    [(0, 3, 2), (2000, 1, 1), (2000, 13, 7), (2000, 60, 80), (2000, 4097, 3)],
)
def test_the_pixels_of_points_are_the_definition(count, width, height):
    pixels, depth = scatter_points(count, width, height)
    found = splat(pixels, depth, width, height)
    assert found.dtype == torch.int64
    assert found.tolist() == plain_splat(pixels, depth, width, height)
    assert (found < width * height).any() == (count > 0)


EDGES = (-0.4, -1e-20, -0.0, 0.0, 1e-20, 0.999, 1.0, 2.5, 4.999, 5.0, 6.999, 7.0, 7.4)
WRONG = (math.nan, math.inf, -math.inf, 1e20, -1e20, 2.0**32, -(2.0**31))
DEPTHS = (*WRONG, 0.0, -0.0, -1.0, 1.0, 1e-20, 1e-42, 3e38)


def test_the_border_of_a_pixel_belongs_to_the_next_and_wrong_points_to_none():
    """A point at a time, at all places and depths; the border of the picture belongs to none."""
    places, depths = torch.tensor((*EDGES, *WRONG)), torch.tensor(DEPTHS)
    for point in torch.cartesian_prod(places, places, torch.ones(1)).split(1):
        given = point[:, :2], point[:, 2], 7, 5
        assert splat(*given).tolist() == plain_splat(*given), point
    for depth in depths.split(1):
        given = torch.tensor([[0.5, 0.5]]), depth, 1, 1
        assert splat(*given).tolist() == plain_splat(*given), depth


def test_wrong_arguments_are_named():
    pixels, depth = torch.zeros(3, 2), torch.ones(3)
    with refusal(r"pixels: expected shape \[3, 2\], got \[3\]", ValueError):
        splat(depth, depth, 5, 4)
    with refusal(r"depth: expected shape \[any\], got \[3, 2\]", ValueError):
        splat(pixels, pixels, 5, 4)

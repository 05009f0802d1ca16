"""The splatting against a plain loop over the points, closed forms and finite differences."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from bench.threads import torch_threads
from methods.steernerf.kernels.splat import splat


def scatter_points(
    count: int, width: int, height: int, dtype: torch.dtype = torch.float32
) -> tuple[Tensor, Tensor]:
    """Points inside and around the picture; many share a depth, some a u or a v, some are equal."""
    generator = torch.Generator().manual_seed(count)
    size = torch.tensor([width, height])
    pixels = (torch.rand(count, 2, generator=generator) * 1.5 - 0.25) * size
    depth = (4 * torch.rand(count, generator=generator)).round() - 1
    return ((4 * pixels).round() / 4).to(dtype), depth.to(dtype)


def one(
    pixels: Tensor, depth: Tensor, width: int, height: int, backend: str = "reference"
) -> Tensor:
    """The picture of a single frame."""
    return splat(pixels, depth, [len(depth)], width, height, backend=backend)[0]


def plain_splat(pixels: Tensor, depth: Tensor, width: int, height: int) -> list[list[int]]:
    """The definition, a point at a time, in Python numbers."""
    shown: dict[tuple[int, int], int] = {}
    for i, ((u, v), z) in enumerate(zip(pixels.tolist(), depth.tolist(), strict=True)):
        if math.isfinite(u) and math.isfinite(v) and math.isfinite(z) and z > 0:
            shown[math.floor(v), math.floor(u)] = i
    return [[shown.get((row, column), -1) for column in range(width)] for row in range(height)]


@pytest.mark.parametrize(
    ("count", "width", "height"),
    [(0, 3, 2), (2000, 1, 1), (2000, 13, 7), (2000, 60, 80), (2000, 4097, 3)],
)
def test_a_picture_is_the_definition(count: int, width: int, height: int) -> None:
    pixels, depth = scatter_points(count, width, height)
    index = one(pixels, depth, width, height)
    assert index.dtype == torch.int32
    assert index.tolist() == plain_splat(pixels, depth, width, height)
    assert (index >= 0).any() == (count > 0)


def test_the_reference_keeps_the_digits_of_float64() -> None:
    pixels, depth = scatter_points(500, 9, 9, torch.float64)
    pixels -= 1e-12  # nothing in float32: over the border of a pixel
    index = one(pixels, depth, 9, 9)
    assert index.tolist() == plain_splat(pixels, depth, 9, 9)


EDGES = (-0.4, -1e-20, -0.0, 0.0, 1e-20, 0.999, 1.0, 2.5, 4.999, 5.0, 6.999, 7.0, 7.4)
WRONG = (math.nan, math.inf, -math.inf, 1e20, -1e20, 2.0**32, -(2.0**31))
DEPTHS = (*WRONG, 0.0, -0.0, -1.0, 1.0, 1e-20, 1e-42, 3e38)


def test_the_border_of_a_pixel_belongs_to_the_next_and_wrong_points_to_none() -> None:
    """A point at a time, at all places and depths; the border of the picture belongs to none."""
    places, depths = torch.tensor((*EDGES, *WRONG)), torch.tensor(DEPTHS)
    for point in torch.cartesian_prod(places, places, torch.ones(1)).split(1):
        got = one(point[:, :2], point[:, 2], 7, 5)
        assert got.tolist() == plain_splat(point[:, :2], point[:, 2], 7, 5), point
    for depth in depths.split(1):
        table = torch.tensor([[0.5, 0.5]]), depth
        want = plain_splat(*table, 1, 1)
        assert one(*table, 1, 1).tolist() == one(*table, 1, 1, "cpu").tolist() == want, depth


def test_frames_have_a_picture_each_and_their_points_one_numbering() -> None:
    pixels, depth = scatter_points(300, 9, 7)
    counts = [100, 0, 200]
    got = splat(pixels, depth, counts, 9, 7, backend="reference")
    assert got.shape == (3, 7, 9)
    first, last = one(pixels[:100], depth[:100], 9, 7), one(pixels[100:], depth[100:], 9, 7)
    assert torch.equal(got[0], first)
    assert (got[1] == -1).all()
    assert torch.equal(got[2], torch.where(last < 0, -1, last + 100))


def test_the_number_of_threads_does_not_change_the_picture() -> None:
    pixels, depth = scatter_points(5000, 50, 3)  # three rows: a thread may be left without any
    pictures = []
    for threads in (1, 2, 4):
        with torch_threads(threads):
            pictures.append(one(pixels, depth, 50, 3, "cpu"))
    assert all(torch.equal(picture, pictures[0]) for picture in pictures)


def test_wrong_arguments_are_named() -> None:
    pixels, depth = torch.zeros(3, 2), torch.ones(3)
    with pytest.raises(ValueError, match=r"pixels: expected shape \[3, 2\], got \[3\]"):
        splat(depth, depth, [3], 5, 4)
    with pytest.raises(ValueError, match=r"depth: expected shape \[3\], got \[2\]"):
        splat(pixels, depth[:2], [3], 5, 4)
    with pytest.raises(ValueError, match="computes with float32"):
        splat(pixels.double(), depth, [3], 5, 4, backend="cpu")

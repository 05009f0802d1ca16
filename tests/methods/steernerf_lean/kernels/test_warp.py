"""The backward warping against a plain loop over the pixels, and closed forms."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from bench.cameras import look_at
from bench.types import Camera
from methods.steernerf_lean.kernels.warp import TOLERANCE
from methods.steernerf_lean.kernels.warp import enlarge as enlarge_cells
from methods.steernerf_lean.kernels.warp import warp as warp_cells
from tests.methods.observations import to_picture

BACKENDS = ["reference", "cpu"]


def straight(width: int, height: int, focal: float = 32.0) -> Camera:
    """A camera at the origin that looks along z."""
    return Camera(torch.eye(3, 4), focal, focal, width / 2, height / 2, width, height)


def elsewhere(camera: Camera) -> Camera:
    """A camera beside it, turned and rolled, of another focal length and size."""
    eye, target, up = torch.tensor([[0.3, -0.2, 0.1], [0.05, 0.1, 2.0], [0.3, -1.0, 0.0]])
    return Camera(look_at(eye, target, up), 40.0, 38.0, 23.0, 15.5, 49, 33)


def moved(camera: Camera, *offset: float) -> Camera:
    return replace(camera, c2w=torch.cat((camera.c2w[:, :3], torch.tensor(offset)[:, None]), 1))


def noise(height: int, width: int, channels: int = 3) -> Tensor:
    return torch.rand(height, width, channels, generator=torch.Generator().manual_seed(height))


def uneven_depth() -> Tensor:
    """Two walls that are a little rough, with holes of every kind."""
    depth = 2 + 0.01 * torch.rand(7, 9, generator=torch.Generator().manual_seed(1))
    depth[:, 5:] += 1.0
    depth[2, 2], depth[3, 6], depth[6, 0] = math.inf, math.nan, -math.inf
    depth[4:, 7:] = math.inf
    depth[0, 3] = 1e20
    return depth


def enlarge(depth: Tensor, scale: int, backend: str) -> Tensor:
    """Of all cells, [h, w, s^2]."""
    cells = torch.arange(depth.numel())
    return enlarge_cells(depth, cells, scale, backend=backend).view(*depth.shape, -1)


def warp(
    picture: Tensor, source: Camera, depth: Tensor, camera: Camera, scale: int, backend: str
) -> tuple[Tensor, Tensor]:
    """Into all cells, whose depth is [h, w] enlarged: [h, w, s^2, C] and [h, w, s^2]."""
    cells = torch.arange(depth.numel())
    fine = enlarge_cells(depth, cells, scale, backend=backend)
    values, valid = warp_cells(picture, source, fine, cells, camera, scale, backend=backend)
    return values.view(*depth.shape, *values.shape[1:]), valid.view(*depth.shape, -1)


def plain_depth(depth: list[list[float]], x: float, y: float) -> float:
    """Depth at (x, y), counted from the centre of pixel (0, 0); inf where there is none."""
    row, column = math.floor(y), math.floor(x)
    corners = []
    for j in (row, row + 1):
        for i in (column, column + 1):
            z = depth[min(max(j, 0), len(depth) - 1)][min(max(i, 0), len(depth[0]) - 1)]
            weight = (1 - abs(x - i)) * (1 - abs(y - j))
            if weight > 0 and math.isfinite(z):
                corners.append((z, weight))
    nearest = min((z for z, _ in corners), default=math.inf)
    kept = [(z, weight) for z, weight in corners if z <= nearest + TOLERANCE]
    total = sum(weight for _, weight in kept)
    return sum(z * weight for z, weight in kept) / total if kept else math.inf


def plain_place(
    depth: Tensor, source: Camera, camera: Camera, scale: int, row: int, column: int
) -> tuple[float, float] | None:
    """Where in the source picture a pixel is looked up, if it is in front of the source."""
    u, v = column + 0.5, row + 0.5
    z = plain_depth(depth.tolist(), u / scale - 0.5, v / scale - 0.5)
    if math.isinf(z):
        return None
    local = torch.tensor(
        [z * (u - camera.cx) / camera.fx, z * (v - camera.cy) / camera.fy, z], dtype=torch.float64
    )
    point = camera.c2w[:, :3].double() @ local + camera.c2w[:, 3].double()
    x, y, ahead = source.c2w[:, :3].double().T @ (point - source.c2w[:, 3].double())
    if ahead <= 0:
        return None
    return (source.fx * x / ahead + source.cx).item(), (source.fy * y / ahead + source.cy).item()


def plain_look_up(picture: Tensor, x: float, y: float) -> Tensor:
    """Bilinear, the border repeated."""
    row, column = math.floor(y - 0.5), math.floor(x - 0.5)
    value = torch.zeros(picture.shape[2], dtype=torch.float64)
    for j in (row, row + 1):
        for i in (column, column + 1):
            clamped = min(max(j, 0), picture.shape[0] - 1), min(max(i, 0), picture.shape[1] - 1)
            value += (1 - abs(x - 0.5 - i)) * (1 - abs(y - 0.5 - j)) * picture[clamped]
    return value


@pytest.mark.parametrize(("scale", "channels"), [(4, 3), (4, 1), (3, 5), (1, 3)])
def test_a_picture_is_the_definition(scale: int, channels: int) -> None:
    width, height = 9, 7
    camera = straight(width * scale, height * scale, focal=8.0 * scale)
    source = elsewhere(camera)
    depth, picture = uneven_depth().double(), noise(source.height, source.width, channels).double()
    values, valid = warp(picture, source, depth, camera, scale, backend="reference")
    assert values.shape == (height, width, scale**2, channels)
    values, valid = to_picture(values, scale), to_picture(valid[..., None], scale)[..., 0]

    for row in range(camera.height):
        for column in range(camera.width):
            place = plain_place(depth, source, camera, scale, row, column)
            want, inside = torch.zeros(channels, dtype=torch.float64), False
            if place is not None:
                x, y = place
                inside = 0 < x < source.width and 0 < y < source.height
                if inside:
                    want = plain_look_up(picture, x, y)
            assert valid[row, column] == inside
            # Coordinates up to 50 are rounded two dozen times; neighbours differ by at most 1.
            torch.testing.assert_close(values[row, column], want, rtol=0, atol=1e-12)
    assert 0.3 < valid.mean() < 0.95


@pytest.mark.parametrize(
    ("backend", "dtype"), [("reference", torch.float64), ("cpu", torch.float32)]
)
@pytest.mark.parametrize("scale", [4, 3, 1])
def test_an_enlarged_depth_is_the_definition(scale: int, backend: str, dtype: torch.dtype) -> None:
    depth = uneven_depth().to(dtype)
    enlarged = to_picture(enlarge(depth, scale, backend=backend)[..., None], scale)[..., 0]
    rows, eps = depth.tolist(), torch.finfo(dtype).eps
    for row in range(len(enlarged)):
        for column in range(enlarged.shape[1]):
            x, y = ((at + 0.5) / scale - 0.5 for at in (column, row))
            # A mean, after eight roundings.
            want = pytest.approx(plain_depth(rows, x, y), rel=4 * eps, abs=0)
            assert enlarged[row, column].item() == want
    assert 0.05 < enlarged.isinf().float().mean() < 0.5


@pytest.mark.parametrize("backend", BACKENDS)
def test_without_a_depth_and_behind_the_source_nothing_is_known(backend: str) -> None:
    camera = straight(12, 8)
    unknown = [(depth, 0.0, 1.0) for depth in (math.inf, -math.inf, math.nan, 0.0)]
    from_behind = [(0.0, -3.0, 1.0), (-1.0, -3.0, 1.0)]  # which the source sees
    for depth, offset, facing in (*unknown, *from_behind, (2.0, 3.0, 1.0), (2.0, 0.0, -1.0)):
        source = moved(camera, 0.0, 0.0, offset)
        source = replace(source, c2w=source.c2w * torch.tensor([facing, 1.0, facing, 1.0]))
        z = torch.full((2, 3), depth)
        values, valid = warp(noise(8, 12), source, z, camera, 4, backend=backend)
        assert not values.any()
        assert not valid.any()


def test_wrong_arguments_are_named() -> None:
    camera, depth, cells = straight(12, 8), torch.ones(6, 16), torch.arange(6)
    picture = torch.zeros(8, 12, 3)
    with pytest.raises(ValueError, match=r"picture: expected shape \[8, 12, any\], got \[8, 11, 3"):
        warp_cells(picture[:, 1:], camera, depth, cells, camera, 4)
    with pytest.raises(ValueError, match=r"depth: expected shape \[6, 16\], got \[96\]"):
        warp_cells(picture, camera, depth.flatten(), cells, camera, 4)
    with pytest.raises(ValueError, match="computes with float32"):
        warp_cells(picture.double(), camera, depth, cells, camera, 4, backend="cpu")
    with pytest.raises(ValueError, match=r"depth: expected shape \[any, any\], got \[96\]"):
        enlarge_cells(depth.flatten(), cells, 4)
    with pytest.raises(ValueError, match="computes with float32"):
        enlarge_cells(depth.double(), cells, 4, backend="cpu")

"""Reprojected pixels: where they were, at borders, in ties, at no depth at all."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from bench.camera_stress import CAMERAS, moved_by, random_motion
from bench.cameras import pixel_grid, project, unproject
from bench.stress import StressCase
from bench.types import Camera
from methods.kernels.case import DTYPES, on_backends
from methods.kernels.splat import splat

WIDTH, HEIGHT = 7, 5

TURNED = torch.diag(torch.tensor([-1.0, 1.0, -1.0]))
ROLLED = torch.diag(torch.tensor([-1.0, -1.0, 1.0]))

NUMBERS = (-math.inf, -1.0, -1e-20, 0.0, 1e-20, 0.5, 1.0, 1e20, math.inf, math.nan)


def cases() -> list[StressCase]:
    """Frames into themselves, turned, rolled; points one by one."""
    found = [
        _case(
            f"same pose, {name}",
            "every pixel shows itself",
            partial(_frame_error, camera, camera, lambda own: own),
        )
        for name, camera in CAMERAS.items()
    ]
    here = CAMERAS["looking at the cube"]
    found += [
        _case(
            "turned by 180 degrees",
            "nothing is seen",
            partial(_frame_error, here, rotated(here, TURNED), lambda own: -torch.ones_like(own)),
        ),
        _case(
            "rolled by 180 degrees",
            "every pixel is opposite",
            partial(_frame_error, here, rotated(here, ROLLED), lambda own: own.flip(0, 1)),
        ),
        _case(
            "rigid motion of scene and cameras",
            "every pixel shows itself",
            partial(_moved_frame_error, 0),
        ),
    ]
    for name, points in (
        ("borders, to the last bit", _borders),
        ("depth 0, negative, 1e-20, 1e20, inf, NaN", _depths),
        ("places inf and NaN", _places),
        ("ties in depth, in u, in all", _ties),
    ):
        found += [
            _case(
                f"{name}, {rule}", "each pixel as of a loop", partial(_points_error, points, rule)
            )
            for rule in ("nearest", "last")
        ]
    return found


def _case(name: str, holds: str, worst: Callable[[str, str, str], float]) -> StressCase:
    return StressCase(
        "splat",
        name,
        holds,
        "decided by comparisons, half a pixel from where they turn: 0 wrong",
        on_backends(0, "fp64"),
        worst,
    )


def rotated(camera: Camera, rotation: Tensor) -> Camera:
    """The camera turned about its own axes."""
    c2w = torch.cat((camera.c2w[:, :3] @ rotation, camera.c2w[:, 3:]), dim=1)
    return replace(camera, c2w=c2w)


def _frame(camera: Camera, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """The pixels of a frame of random depth, as points; their indices as a picture."""
    pixels = pixel_grid(camera.width, camera.height).to(dtype)
    depth = 10 ** torch.empty(len(pixels)).uniform_(
        -1, 3, generator=torch.Generator().manual_seed(0)
    ).to(dtype)
    own = torch.arange(len(pixels)).view(camera.height, camera.width)
    return unproject(camera, pixels, depth), own


def _wrong(points: Tensor, camera: Camera, want: Tensor, backend: str, device: str) -> float:
    pixels, depth = project(replace(camera, c2w=camera.c2w.to(device)), points.to(device))
    index = splat(pixels, depth, camera.width, camera.height, backend=backend)
    return float((index.cpu() != want).sum())


def _frame_error(
    source: Camera,
    camera: Camera,
    expected: Callable[[Tensor], Tensor],
    backend: str,
    device: str,
    precision: str,
) -> float:
    """How many pixels show something else."""
    points, own = _frame(source, DTYPES[precision])
    return _wrong(points, camera, expected(own), backend, device)


def _moved_frame_error(seed: int, backend: str, device: str, precision: str) -> float:
    rotation, translation = random_motion(seed)
    camera, dtype = CAMERAS["looking at the cube"], DTYPES[precision]
    points, own = _frame(camera, dtype)
    moved = (points.double() @ rotation.T + translation).to(dtype)
    return _wrong(moved, moved_by(camera, rotation, translation), own, backend, device)


def _borders() -> tuple[Tensor, Tensor]:
    """Around each border of the picture, the number before it, it, and the number after it."""
    edges = []
    for edge in (0.0, 1.0, WIDTH - 1.0, WIDTH, HEIGHT - 1.0, HEIGHT):
        at = torch.tensor(edge)
        edges += [at.nextafter(torch.tensor(-math.inf)), at, at.nextafter(torch.tensor(math.inf))]
    places = torch.stack(edges)
    return torch.cartesian_prod(places, places), torch.ones(len(places) ** 2)


def _depths() -> tuple[Tensor, Tensor]:
    depth = torch.tensor(NUMBERS)
    return torch.full((len(depth), 2), 2.5), depth


def _places() -> tuple[Tensor, Tensor]:
    places = torch.cartesian_prod(torch.tensor(NUMBERS), torch.tensor(NUMBERS))
    return places, torch.ones(len(places))


def _ties() -> tuple[Tensor, Tensor]:
    """All of them in one pixel or the next."""
    u, v = torch.tensor([2.25, 2.5, 3.0]), torch.tensor([1.0, 1.5])
    corners = torch.cartesian_prod(u, v, torch.tensor([1.0, 1.0 + 2**-23]))
    points = torch.cat((corners, corners.flip(0), corners))
    return points[:, :2], points[:, 2]


def _points_error(
    make: Callable[[], tuple[Tensor, Tensor]],
    rule: str,
    backend: str,
    device: str,
    precision: str,
) -> float:
    """How many pixels show another point than a loop over all points lets them."""
    pixels, depth = (x.to(DTYPES[precision]) for x in make())
    shown: dict[tuple[int, int], int] = {}
    for point, ((u, v), z) in enumerate(zip(pixels.tolist(), depth.tolist(), strict=True)):
        if 0 <= u < WIDTH and 0 <= v < HEIGHT and 0 < z < math.inf:
            cell = int(v), int(u)
            before = shown.get(cell)
            hidden = before is not None and rule == "nearest"
            if not hidden or (z, u, v) < (depth[before].item(), *pixels[before].tolist()):
                shown[cell] = point
    want = torch.full((HEIGHT, WIDTH), -1)
    for cell, point in shown.items():
        want[cell] = point
    pixels, depth = pixels.to(device), depth.to(device)
    got = splat(pixels, depth, WIDTH, HEIGHT, rule=rule, backend=backend)  # type: ignore[arg-type]
    return float((got.cpu() != want).sum())

"""Cases of projection and unprojection: near, far, tiny scenes, odd sizes, rigid motions."""

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import product

import torch
from torch import Tensor

from bench.cameras import cast, look_at, move_camera, pixel_grid, place_camera, project, unproject
from bench.case import U32, Case, Cases, Property
from bench.types import Camera

IDENTITY = torch.eye(4)[:3]
ROLL = torch.tensor([[-1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, 1, 0]])
EYE, UP = torch.tensor([1.7, -0.8, 1.1]), torch.tensor([0.0, 0.0, 1.0])
CUBE = look_at(EYE, torch.full((3,), 0.5), UP)

CAMERAS = {
    "at the origin": Camera(IDENTITY, 40.0, 40.0, 16.0, 12.0, 32, 24),
    "looking at the cube": Camera(CUBE, 40.0, 42.0, 16.0, 12.0, 32, 24),
    "1 x 1 picture": Camera(IDENTITY, 1.0, 1.0, 0.5, 0.5, 1, 1),
    "4097 x 3 picture": Camera(IDENTITY, 4000.0, 4000.0, 2048.5, 1.5, 4097, 3),
    "principal point off the picture": Camera(IDENTITY, 40.0, 40.0, -500.0, 900.0, 32, 24),
    "focal length 1e-3": Camera(IDENTITY, 1e-3, 1e-3, 16.0, 12.0, 32, 24),
    "focal length 1e6": Camera(IDENTITY, 1e6, 1e6, 16.0, 12.0, 32, 24),
    "rolled by 180 degrees": Camera(ROLL, 40.0, 40.0, 16.0, 12.0, 32, 24),
}
DEPTHS = (1e-20, 1e-3, 1.0, 1e6, 1e20)


def cases() -> Cases:
    """Cases that project and unproject points at all scales, or move everything rigidly."""
    front = _property("projection", "its depth is not positive, its pixel finite", "comparisons: 0")
    pixels = _property(
        "normalisation",
        "rays of the unit cube go through the pixels of the data set's",
        "the camera's position rounded, projected: 16 (reach + f) u",
        16 * (32 + 42),
    )
    moved = _property(
        "cameras",
        "pixels do not move",
        "points of size 3 in a rotation of 3 products, twice: 64 (reach + f) u",
        64 * (32 + 42),
    )
    return [
        *_round_trips(),
        front.case("behind the camera", _not_in_front, (-1e20, -1.0, -1e-20)),
        front.case("on the camera's plane", _not_in_front, (0.0, -0.0)),
        pixels.case("a scene 1e-06 wide", _normalisation_error, 1e-6),
        pixels.case("a scene 1e+06 wide", _normalisation_error, 1e6),
        moved.case("rigid motion of scene and camera", _motion_error),
    ]


def _property(subject: str, holds: str, derivation: str, units: float = 0.0) -> Property:
    return Property(subject, holds, derivation, {("torch", "fp32"): units * U32})


def _round_trips() -> Iterator[Case]:
    for (name, camera), depth in product(CAMERAS.items(), DEPTHS):
        reach = max(abs(camera.cx), abs(camera.cy), *camera.size)
        distance, units = camera.centre.norm().item(), 8 * reach
        if distance and depth < 1:
            continue  # nearer than the rounding error of the camera position
        if distance:
            units += 8 * reach + 8 * max(camera.fx, camera.fy) * (1 + distance / depth)
        same = _property(
            "projection",
            "a pixel unprojected and projected is the same pixel",
            "(u - c) / f and back, 4 roundings each at the size of the picture: 8 reach u; "
            "turned, as many more; away from the origin by r, 8 f (1 + r / z) u more",
            units,
        )
        yield same.case(f"{name}, depth {depth:g}", _round_trip, camera, depth)


def _apart(got: Tensor, want: Tensor) -> float:
    """Largest difference; inf if any value is not finite."""
    return (got.double() - want.double()).abs().nan_to_num(nan=math.inf).max().item()


def _round_trip(camera: Camera, depth: float, backend: str, device: str, precision: str) -> float:
    tolerated = 16 * (1 + camera.centre.norm().item() / depth) * U32
    camera = place_camera(camera, device)
    pixels = pixel_grid(*camera.size, device)
    points = unproject(camera, pixels, torch.full_like(pixels[:, 0], depth))
    got, got_depth = project(camera, points)
    relative = (got_depth / depth - 1).abs().max().item()
    return _apart(got, pixels) if relative <= tolerated else math.inf


def _not_in_front(depths: tuple[float, ...], backend: str, device: str, precision: str) -> float:
    camera = CAMERAS["at the origin"]
    sides = torch.cartesian_prod(torch.tensor([-1e20, -1.0, 0.0, 1.0]), torch.tensor(depths))
    points = torch.stack((sides[:, 0], sides[:, 0], sides[:, 1]), dim=1).to(device)
    pixels, depth = project(place_camera(camera, device), points)
    fine = bool((depth <= 0).all()) and bool(pixels.isfinite().all())
    return 0.0 if fine else math.inf


def _normalisation_error(side: float, backend: str, device: str, precision: str) -> float:
    """Pixel error after normalising a cube of `side` that lies some 10^4 sides from the origin."""
    camera = CAMERAS["looking at the cube"]
    origin = side * torch.tensor([1e4, -2e4, 3e4], dtype=torch.float64)
    centre = origin + side * camera.centre.double()
    pose = torch.column_stack((camera.rotation.double(), centre))
    there = replace(camera, c2w=pose)
    moved = move_camera(there, 1 / side, -origin / side)
    rays = cast(place_camera(moved, device))
    points = (rays.origins + 2 * rays.directions).cpu().double()
    pixels, _ = project(there, origin + side * points)
    return _apart(pixels, pixel_grid(*camera.size))


def _motion_error(backend: str, device: str, precision: str) -> float:
    """Pixels by which points of the unit cube shift when they and the camera move rigidly."""
    generator = torch.Generator().manual_seed(0)
    rotation, _ = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64))
    rotation[:, 0] *= torch.linalg.det(rotation).sign()
    translation = 2 * torch.rand(3, generator=generator, dtype=torch.float64) - 1
    points = torch.rand(200, 3, generator=generator)
    camera = CAMERAS["looking at the cube"]
    pose = rotation @ camera.c2w.double()
    pose[:, 3] += translation
    there = (points.double() @ rotation.T + translation).float()
    pixels, _ = project(place_camera(camera, device), points.to(device))
    moved = place_camera(replace(camera, c2w=pose.float()), device)
    again, _ = project(moved, there.to(device))
    return _apart(again, pixels)

"""Rays, projection and scaling of pinhole cameras, with one pixel-centre convention.

Pixel (i, j) (column i, row j) covers [i, i+1) x [j, j+1) and is sampled at its centre, +0.5.
"""

from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import normalize

from bench.types import Camera, Rays, TwoTensors, check_shape


def pixel_grid(width: int, height: int, device: torch.device | str = "cpu") -> Tensor:
    """Centres of all pixels, row by row: [height * width, 2] as (u, v)."""
    u = torch.arange(width, device=device, dtype=torch.float32) + 0.5
    v = torch.arange(height, device=device, dtype=torch.float32) + 0.5
    return torch.stack(torch.meshgrid(u, v, indexing="xy"), dim=-1).reshape(-1, 2)


def cast(camera: Camera, pixels: Tensor | None = None) -> Rays:
    """Rays through `pixels` [R, 2] as (u, v), or through all pixel centres, row by row."""
    if pixels is None:
        pixels = pixel_grid(*camera.size, camera.c2w.device)
    check_shape("pixels", pixels, None, 2)
    x = (pixels[:, 0] - camera.cx) / camera.fx
    y = (pixels[:, 1] - camera.cy) / camera.fy
    local = torch.stack((x, y, torch.ones_like(x)), dim=-1)
    rotation = camera.rotation.to(local.dtype)
    directions = local @ rotation.T
    return Rays(camera.centre.to(local.dtype).expand_as(directions), directions)


def unproject(camera: Camera, pixels: Tensor, depth: Tensor) -> Tensor:
    """World points [R, 3] at z-depth `depth` [R] behind continuous `pixels` [R, 2] (Eq. 6)."""
    rays = cast(camera, pixels)
    return rays.origins + depth[:, None] * rays.directions


def project(camera: Camera, points: Tensor) -> TwoTensors:
    """Pixels [..., 2] and z-depth [...] of `points` [..., 3] (Eq. 7, 9); none unless depth > 0."""
    check_shape("points", points, *[None] * (points.dim() - 1), 3)
    rotation = camera.rotation.to(points.dtype)
    centre = camera.centre.to(points.dtype)
    local = (points - centre) @ rotation  # R^T (p - c), row vectors
    x, y, depth = local.unbind(dim=-1)
    safe = torch.where(depth > 0, depth, torch.ones_like(depth))
    pixels = (
        camera.fx * x / safe + camera.cx,
        camera.fy * y / safe + camera.cy,
    )
    return torch.stack(pixels, dim=-1), depth


def within(pixels: Tensor, width: int, height: int) -> Tensor:
    """Whether continuous `pixels` [..., 2] lie inside a picture of that size, [...] bool."""
    u, v = pixels.unbind(dim=-1)
    return (u >= 0) & (u < width) & (v >= 0) & (v < height)


def scale_camera(camera: Camera, width: int, height: int) -> Camera:
    """The same view on `width` x `height` pixels; with centres at +0.5, 1/4 and back is exact."""
    sx, sy = width / camera.width, height / camera.height
    fx, fy, cx, cy = camera.fx * sx, camera.fy * sy, camera.cx * sx, camera.cy * sy
    return Camera(camera.c2w, fx, fy, cx, cy, width, height)


def frame_camera(camera: Camera, width: int, height: int) -> Camera:
    """The view on `width` x `height` pixels: same vertical field of view, wider or narrower."""
    zoom = height / camera.height
    cx, cy = width / 2 + (camera.cx - camera.width / 2) * zoom, camera.cy * zoom
    return Camera(camera.c2w, camera.fx * zoom, camera.fy * zoom, cx, cy, width, height)


def crop_camera(camera: Camera, left: int, top: int, width: int, height: int) -> Camera:
    """The camera of a crop: `width` x `height` pixels, beginning at column `left`, row `top`."""
    return replace(camera, cx=camera.cx - left, cy=camera.cy - top, width=width, height=height)


def move_camera(
    camera: Camera, scale: float, offset: Tensor, dtype: torch.dtype = torch.float32
) -> Camera:
    """The same view after x becomes scale * x + offset [3]; in float64, for cameras far away."""
    pose = camera.c2w.double()
    centre = scale * pose[:, 3:] + offset.to(pose)[:, None]
    return replace(camera, c2w=torch.cat((pose[:, :3], centre), dim=1).to(dtype))


def place_camera(camera: Camera, device: torch.device | str) -> Camera:
    """The same camera with its pose on `device`; the host waits only for a pose on a GPU."""
    waits = camera.c2w.device.type != "cpu"
    return replace(camera, c2w=camera.c2w.to(device, non_blocking=not waits))


def pack_camera(camera: Camera) -> Tensor:
    """`camera` as one [18] float64 tensor on the CPU: `c2w` row by row, then the intrinsics."""
    pose = camera.c2w.double().cpu().flatten()
    return torch.cat((pose, pose.new_tensor((*camera.intrinsics, *camera.size))))


def unpack_camera(packed: Tensor) -> Camera:
    """The camera that `pack_camera` packed, bit for bit, on the CPU."""
    fx, fy, cx, cy, width, height = packed[12:].tolist()
    return Camera(packed[:12].view(3, 4).float(), fx, fy, cx, cy, int(width), int(height))


def look_at(eye: Tensor, target: Tensor, up: Tensor) -> Tensor:
    """Camera-to-world [3, 4] at `eye`, looking at `target`, with `up` upward in the picture."""
    forward = normalize(target - eye, dim=0)
    right = normalize(torch.linalg.cross(forward, up), dim=0)
    return torch.stack((right, torch.linalg.cross(forward, right), forward, eye), dim=1)

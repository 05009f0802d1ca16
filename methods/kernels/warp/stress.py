"""The preceding picture in the present view: the same view, opposite ones, a very long walk."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from bench.camera_stress import CAMERAS
from bench.cameras import look_at, pixel_grid
from bench.stress import StressCase
from bench.types import Camera
from methods.kernels.case import DTYPES, on_backends
from methods.kernels.splat.stress import ROLLED, TURNED, rotated
from methods.kernels.warp import enlarge, warp

BACK = "x, y and w rounded 6 times at the size of the picture, looked up twice: 24 reach + 8 u"


def cases() -> list[StressCase]:
    """Same and opposite views, no depth and extreme ones, inside of what is seen, a walk."""
    found = [
        _case(
            f"same pose, {name}, depth {depth:g}",
            "the picture stays what it is",
            BACK,
            24 * max(abs(camera.cx), abs(camera.cy), camera.width, camera.height) + 8,
            partial(_same_error, camera, camera, depth, False),
            exact=not camera.c2w[:, 3].any(),
        )
        for name, camera in CAMERAS.items()
        for depth in (1e-20, 1.0, 1e20)
    ]
    here = CAMERAS["looking at the cube"]
    found += [
        _case(
            "rolled by 180 degrees",
            "the picture stands on its head",
            BACK,
            24 * 32 + 8,
            partial(_same_error, here, rotated(here, ROLLED), 1.0, True),
            exact=False,
        ),
        _case(
            "depth 1e38, of which products are infinite",
            "what is known is what it was",
            BACK,
            24 * 32 + 8,
            partial(_known_error, CAMERAS["at the origin"], 1e38),
        ),
        *(
            _case(name, "nothing is known", "comparisons: 0", 0, partial(_seen, there, depth))
            for name, there, depth in (
                ("turned by 180 degrees", rotated(here, TURNED), 1.0),
                ("depth inf", here, math.inf),
                ("depth NaN", here, math.nan),
                ("depth 0", here, 0.0),
                ("depth 0, seen from behind", _ahead(here), 0.0),
                ("depth -1, seen from behind", _ahead(here), -1.0),
                ("depth -inf", here, -math.inf),
            )
        ),
        _case(
            "camera inside the object",
            "what is known is what float64 says",
            "24 reach u as at the same pose, twice with an offset as large as what it is added to, "
            "in a picture that rises by 1 over its width, and looked up: 56 u",
            56,
            _inside_error,
        ),
        _case(
            "enlarged depth of inf, NaN, 1e20 and 1",
            "finite only where a neighbour is, and one of them",
            "depths that far apart do not mix; a mean of one has 8 roundings: 8 u",
            8,
            _enlarged_error,
        ),
    ]
    found += [
        _case(
            f"{frames:,} frames there and back",
            "a constant stays what it is, and the rest within its range",
            "a look-up has 4 roundings, all of which may point the same way: 4 n u",
            4 * frames,
            partial(_walk_error, frames),
            slow=frames > 1000,
        )
        for frames in (300, 10_000)
    ]
    return found


def _case(
    name: str,
    holds: str,
    derivation: str,
    units: float,
    worst: Callable[[str, str, str], float],
    *,
    slow: bool = False,
    exact: bool = True,
) -> StressCase:
    """`exact`: poses are so in float32, and there is something to see in fp64."""
    cells = on_backends(units, *(["fp64"] if exact else []))
    return StressCase("warp", name, holds, derivation, cells, worst, slow)


def _ahead(camera: Camera) -> Camera:
    """The camera, 3 units nearer to what it looks at."""
    centre = camera.c2w[:, 3:] + 3 * camera.c2w[:, 2:3]
    return replace(camera, c2w=torch.cat((camera.c2w[:, :3], centre), dim=1))


def _picture(camera: Camera, dtype: torch.dtype) -> Tensor:
    generator = torch.Generator().manual_seed(0)
    return torch.rand(camera.height, camera.width, 3, generator=generator).to(dtype)


def _warped(
    source: Camera, camera: Camera, depth: Tensor, picture: Tensor, backend: str, device: str
) -> tuple[Tensor, Tensor]:
    """Values [H, W, C] and what is known [H, W] of the view of `camera`; cells are pixels."""
    cells = torch.arange(depth.numel(), device=device)
    size = camera.height, camera.width
    values, valid = warp(
        picture.to(device), source, depth.view(-1, 1).to(device), cells, camera, 1, backend=backend
    )
    return values.view(*size, -1).cpu(), valid.view(size).cpu()


def _same_error(
    source: Camera,
    camera: Camera,
    depth: float,
    flipped: bool,
    backend: str,
    device: str,
    precision: str,
) -> float:
    picture = _picture(source, DTYPES[precision])
    z = torch.full((camera.height * camera.width,), depth, dtype=picture.dtype)
    values, valid = _warped(source, camera, z, picture, backend, device)
    want = picture.flip(0, 1) if flipped else picture
    return (values - want).abs().max().item() if valid.all() else math.inf


def _known_error(camera: Camera, depth: float, backend: str, device: str, precision: str) -> float:
    picture = _picture(camera, DTYPES[precision])
    z = torch.full((camera.height * camera.width,), depth, dtype=picture.dtype)
    values, valid = _warped(camera, camera, z, picture, backend, device)
    return (values - picture * valid[..., None]).abs().max().item()


def _seen(camera: Camera, depth: float, backend: str, device: str, precision: str) -> float:
    """Largest of what is said to be known, and of the values."""
    source = CAMERAS["looking at the cube"]
    picture = _picture(source, DTYPES[precision])
    z = torch.full((camera.height * camera.width,), depth, dtype=picture.dtype)
    values, valid = _warped(source, camera, z, picture, backend, device)
    return max(values.abs().max().item(), valid.max().item())


def _inside_error(backend: str, device: str, precision: str) -> float:
    """A step of 0.1 to the side, surfaces as near as that, a picture that is linear in u and v."""
    camera = CAMERAS["at the origin"]
    c2w = camera.c2w.clone()
    c2w[0, 3] = 0.1
    source, dtype = replace(camera, c2w=c2w), DTYPES[precision]
    pixels = pixel_grid(camera.width, camera.height).double()
    picture = (pixels / 32).view(camera.height, camera.width, 2).to(dtype)
    z = torch.rand(len(pixels), generator=torch.Generator().manual_seed(0)).to(dtype)
    values, valid = _warped(source, camera, z, picture, backend, device)
    if not valid.any():
        return math.inf
    u = pixels[:, 0] - source.fx * source.c2w[0, 3].double() / z.double()
    u = u.clamp(0.5, camera.width - 0.5)  # the border is repeated
    want = torch.stack((u, pixels[:, 1]), dim=1).view(camera.height, camera.width, 2) / 32
    apart = (values - want).abs().amax(dim=2) * (valid > 0)
    return apart.max().item()


def _enlarged_error(backend: str, device: str, precision: str) -> float:
    dtype = DTYPES[precision]
    depth = torch.full((5, 5), torch.inf, dtype=dtype)
    depth[1, 1], depth[1, 2], depth[3, 3], depth[4, 0] = 1.0, 1e20, 1e20, torch.nan
    cells = torch.arange(25, device=device)
    got = enlarge(depth.to(device), cells, 4, backend=backend).cpu()
    known = got[got < torch.inf].double()
    if got.isnan().any() or not len(known):
        return math.inf
    return torch.minimum((known - 1).abs(), (known / depth[1, 2].double() - 1).abs()).max().item()


def _walk_error(frames: int, backend: str, device: str, precision: str) -> float:
    """Around a quarter of the scene and back, 50 frames each way, each frame from the last."""
    start = Camera(torch.eye(4)[:3], 8.0, 8.0, 4.0, 4.0, 8, 8)
    up, middle = torch.tensor([0.0, 0.0, 1.0]), torch.full((3,), 0.5)
    first = torch.rand(8, 8, 3, generator=torch.Generator().manual_seed(0)).to(DTYPES[precision])
    first[..., 0] = 0.7
    picture, before, worst = first, None, 0.0
    z = torch.full((64,), 1.5, dtype=first.dtype)
    for frame in range(frames):
        angle = 0.03 * (50 - abs(frame % 100 - 50))
        eye = middle + 1.5 * torch.tensor([math.cos(angle), math.sin(angle), 0.2])
        camera = replace(start, c2w=look_at(eye, middle, up))
        if before is not None:
            values, valid = _warped(before, camera, z, picture, backend, device)
            if not valid.any():
                return math.inf
            picture = torch.where(valid[..., None] > 0, values, first)
        before = camera
        drift = (picture[..., 0] - 0.7).abs().max().item()
        beyond = (picture - 0.5).abs().max().item() - 0.5
        worst = max(worst, drift, beyond) if picture.isfinite().all() else math.inf
    return worst

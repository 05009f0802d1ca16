"""Cases of the projection of Gaussians: agreement of the backends, ellipses known in advance."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial

import torch
from torch import Tensor
from torch.func import jacrev, vmap

from bench.cameras import project
from bench.case import DTYPES, U32, Agreement, Case, Property, on_backends
from bench.cases import CAMERAS
from bench.types import Camera
from methods.gaussians.kernels.projection import (
    BLUR,
    FRUSTUM,
    LEAST_ALPHA,
    Ellipses,
    covariances,
    project_gaussians,
)
from methods.kernels.dispatch import served

CAMERA = CAMERAS["looking at the cube"]
FAR = 3.0
"""Bound on the variance of an ellipse over the least, `BLUR`; scales and depths ensure it."""

Gaussians = tuple[Tensor, Tensor, Tensor, Tensor]
"""Means, scales, rotations, opacities."""


def cases() -> list[Case]:
    """No, one and many Gaussians, some behind the camera; circles; slopes by autograd."""
    backends = served(__package__)
    forward = Agreement(
        "gaussian projection",
        backends,
        "centres in widths of the picture and conics, of an area that loses a factor of "
        "xx yy / area < 64, after 30 roundings of numbers below 4: 8,000 u",
    )
    backward = Agreement(
        "gaussian projection backward",
        backends,
        "relative to the largest gradient of its kind: conics, off by 8,000 u, twice",
    )
    found = []
    for count in (0, 1, 1000, 1 << 16):
        name, items = f"{count:,} Gaussians", count if count > 1000 else None
        found += [
            forward.case(name, partial(_ellipses, count), 8000 * U32, items=items),
            backward.case(name, partial(_gradients, count), 16000 * U32, items=items),
        ]
    circle = Property(
        "gaussian projection",
        "a round Gaussian on the axis is an ellipse of known axes, circles but for fx and fy",
        "relative: 30 roundings, and twice that of its depth, which a place near 1 has to 2 u",
        on_backends(30, backends=backends),
    )
    for scale, depth in ((1e-3, 0.5), (0.1, 1.0), (0.02, 5.0)):
        name = f"scale {scale:g} at depth {depth:g}"
        found.append(circle.case(name, partial(_circle_error, scale, depth)))
    slopes = Property(
        "gaussian projection",
        "the ellipse is that of the derivative of the projection, by autograd",
        "as in the agreement of the backends: 8,000 u",
        on_backends(8000, "fp64", backends=backends),
    )
    hidden = Property(
        "gaussian projection",
        "nothing is shown, and no gradient is not finite",
        "decided by comparisons: 0 wrong",
        on_backends(0, "fp64", backends=backends),
    )
    found.append(slopes.case("in the picture", _slopes_error))
    for name, changed in HIDDEN.items():
        found.append(hidden.case(name, partial(_shown, changed)))
    return found


def draw(count: int, device: str = "cpu") -> Gaussians:
    """Gaussians seen by `CAMERA`, one to four pixels wide, in and around its picture; an eighth of
    them are behind it."""
    generator = torch.Generator().manual_seed(count)
    depth = 0.5 + 2.5 * torch.rand(count, generator=generator)
    across = 3 * torch.rand(count, 2, generator=generator) - 1.5  # of half the picture
    edge = (across.abs() - FRUSTUM).abs() < 0.01  # on which side of it, rounding would decide
    across[edge] *= 0.9
    half = torch.tensor((0.5 * CAMERA.width / CAMERA.fx, 0.5 * CAMERA.height / CAMERA.fy))
    depth[: count // 8] *= -1
    local = torch.cat((depth[:, None] * half * across, depth[:, None]), dim=1)
    means = local @ CAMERA.c2w[:, :3].T + CAMERA.c2w[:, 3]
    scales = torch.rand(count, 3, generator=generator) * 0.5 / CAMERA.fx + 1e-3
    rotations = torch.randn(count, 4, generator=generator)
    opacities = torch.rand(count, generator=generator)
    return means.to(device), scales.to(device), rotations.to(device), opacities.to(device)


def _projected(given: Sequence[Tensor], camera: Camera, backend: str) -> Ellipses:
    means, scales, rotations, opacities = given
    return project_gaussians(means, scales, rotations, opacities, camera, backend=backend)


def _on(device: str) -> Camera:
    return Camera(CAMERA.c2w.to(device), *(getattr(CAMERA, name) for name in INTRINSICS))


INTRINSICS = ("fx", "fy", "cx", "cy", "width", "height")


def _ellipses(count: int, device: str) -> Callable[[str], tuple[Tensor, ...]]:
    given, camera = draw(count, device), _on(device)

    def call(backend: str) -> tuple[Tensor, ...]:
        found, size = _projected(given, camera, backend), camera.width
        return found.centres / size, found.conics, found.depth, found.extents / size

    return call


def _gradients(count: int, device: str) -> Callable[[str], tuple[Tensor, ...]]:
    means, scales, rotations, opacities = draw(count, device)
    camera, generator = _on(device), torch.Generator().manual_seed(1)
    towards = [torch.randn(count, n, generator=generator).to(device) for n in (2, 3)]

    def gradients(backend: str) -> tuple[Tensor, ...]:
        given = [x.detach().requires_grad_() for x in (means, scales, rotations)]
        found = _projected([*given, opacities], camera, backend)
        return torch.autograd.grad((found.centres, found.conics), given, towards)

    largest = [float(x.abs().max()) if count else 1.0 for x in gradients("reference")]
    return lambda backend: tuple(
        grad.div_(size) for grad, size in zip(gradients(backend), largest, strict=True)
    )


def _circle_error(scale: float, depth: float, backend: str, device: str, precision: str) -> float:
    camera, dtype = _on(device), DTYPES[precision]
    place = camera.c2w[:, 3] + depth * camera.c2w[:, 2]
    turn = torch.randn(1, 4, generator=torch.Generator().manual_seed(0))
    given = place[None], torch.full((1, 3), scale), turn, torch.tensor([1.0])
    found = _projected([x.to(device, dtype) for x in given], camera, backend)
    # The actual depth, because the position was rounded to float32.
    z = float((place - camera.c2w[:, 3]).double() @ camera.c2w[:, 2].double())
    size = float(given[1][0, 0].to(dtype)) / z
    across, down = (camera.fx * size) ** 2 + BLUR, (camera.fy * size) ** 2 + BLUR
    reach = 2 * math.log(1 / LEAST_ALPHA)
    a, b, c = found.conics[0].tolist()
    wide, tall = found.extents[0].tolist()
    errors = (
        a * across - 1,
        b * math.sqrt(across * down),
        c * down - 1,
        wide / math.sqrt(reach * across) - 1,
        tall / math.sqrt(reach * down) - 1,
    )
    return max(abs(error) for error in errors)


def _slopes_error(backend: str, device: str, precision: str) -> float:
    camera, dtype = _on(device), DTYPES[precision]
    means, scales, rotations, opacities = (x.to(dtype) for x in draw(1000, device))
    pixels, depth = project(camera, means)
    size = pixels.new_tensor((camera.width, camera.height))
    seen = (depth > 0.1) & ((pixels > 0) & (pixels < size)).all(dim=1) & (opacities > 0.01)
    given = [x[seen] for x in (means, scales, rotations, opacities)]
    found = _projected(given, camera, backend)
    exact = [x.double().cpu() for x in given]
    here = CAMERA

    def centre(point: Tensor) -> Tensor:
        return project(here, point[None])[0][0]

    slopes = vmap(jacrev(centre))(exact[0])  # [n, 2, 3]
    spread = slopes @ covariances(*exact[1:3]) @ slopes.transpose(1, 2)
    inverse = (spread + BLUR * torch.eye(2, dtype=torch.float64)).inverse()
    conics = torch.stack((inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 1]), dim=1)
    return (found.conics.double().cpu() - conics).abs().max().item()


HIDDEN: dict[str, dict[str, float]] = {
    "behind the camera": {"depth": -1.0},
    "at the camera": {"depth": 0.0},
    "too faint": {"opacity": LEAST_ALPHA / 2},
    "opacity 0": {"opacity": 0.0},
    "not a number": {"depth": math.nan},
    "infinitely far": {"depth": math.inf},
    "infinitely large": {"scale": math.inf},
}


def _shown(changed: dict[str, float], backend: str, device: str, precision: str) -> float:
    camera, dtype = _on(device), DTYPES[precision]
    depth, scale = changed.get("depth", 1.0), changed.get("scale", 0.01)
    place = camera.c2w[:, 3] + depth * camera.c2w[:, 2]
    opacity = torch.tensor([changed.get("opacity", 0.5)])
    given = [
        x.to(device, dtype).requires_grad_()
        for x in (place[None], torch.full((1, 3), scale), torch.tensor([[1.0, 0, 0, 0]]))
    ]
    found = _projected([*given, opacity.to(device, dtype)], camera, backend)
    (found.centres.sum() + found.conics.sum()).backward()
    wrong = found.extents.count_nonzero().item()
    return float(
        wrong + sum((~x.grad.isfinite()).sum().item() for x in given if x.grad is not None)
    )

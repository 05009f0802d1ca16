"""Cases of the projection of Gaussians: agreement of the backends, ellipses known in advance."""

import math
from typing import Any

import torch
from torch import Tensor
from torch.func import jacrev, vmap

from bench.cameras import project
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
from bench.cases import CAMERAS
from bench.types import Camera
from methods.gaussians.kernels.projection import (
    BLUR,
    FRUSTUM,
    LEAST_ALPHA,
    covariances,
    project_gaussians,
)
from methods.kernels.dispatch import served

CAMERA = CAMERAS["looking at the cube"]

AREA = (
    "conics, of an area that loses a factor of xx yy / area < 64, after 30 roundings of numbers "
    "below 4: 8,000 u"
)


def _ellipses(camera: Camera, **given: Any) -> tuple[Tensor, ...]:
    ellipses, size = project_gaussians(**given, camera=camera), camera.width
    depth = ellipses.depth.detach()  # which has no gradient
    return ellipses.centres / size, ellipses.conics, depth, ellipses.extents / size


RELATIVE = Bound(f"relative to the largest of its kind, twice that of {AREA}", 16000 * U32)
PROJECT = Operation(
    "gaussian projection",
    served(__package__),
    _ellipses,
    {
        "centres": Bound("in widths of the picture, 30 roundings of numbers below 4", 240 * U32),
        "conics": Bound(AREA, 8000 * U32),
        "depths": Bound("10 roundings of numbers below 4, by both", 80 * U32),
        "extents": Bound("in widths of the picture, 60 roundings of numbers below 4", 480 * U32),
    },
    dict.fromkeys(("means", "scales", "rotations"), RELATIVE),
    relative=True,
)


def cases() -> Cases:
    """No, one and many Gaussians, some behind the camera; circles; slopes by autograd."""
    found = []
    for count in (0, 1, 1000, 1 << 16):
        found += PROJECT.cases(f"{count:,} Gaussians", _given, count, items=count)
    slopes = Property(
        PROJECT.subject,
        "the ellipse is that of the derivative of the projection, by autograd",
        "as in the agreement of the backends: 8,000 u",
        on_backends(8000, "fp64"),
    )
    holds, why = "nothing shows, and no gradient is not finite", "decided by comparisons: 0 wrong"
    hidden = Property(PROJECT.subject, holds, why, on_backends(0, "fp64"))
    found += (hidden.case(name, _shown, changed) for name, changed in HIDDEN.items())
    return [*found, slopes.case("in the picture", _slopes_error)]


def _given(count: int) -> Given:
    """Gaussians seen by `CAMERA`, one to four pixels wide, in and around its picture; an eighth of
    them are behind it."""
    random = Random(count)
    depth = 0.5 + 2.5 * random.share(count)
    across = 3 * random.share(count, 2) - 1.5  # of half the picture
    edge = (across.abs() - FRUSTUM).abs() < 0.01  # on which side of it, rounding would decide
    across[edge] *= 0.9
    half = torch.tensor((0.5 * CAMERA.width / CAMERA.fx, 0.5 * CAMERA.height / CAMERA.fy))
    depth[: count // 8] *= -1
    local = torch.cat((depth[:, None] * half * across, depth[:, None]), dim=1)
    return {
        "means": local @ CAMERA.rotation.T + CAMERA.centre,
        "scales": random.share(count, 3) * 0.5 / CAMERA.fx + 1e-3,
        "rotations": random.normal(count, 4),
        "opacities": random.share(count),
        "camera": CAMERA,
    }


def _slopes_error(backend: str, device: str, precision: str) -> float:
    drawn = placed(_given(1000), device, precision)
    camera = drawn.pop("camera")
    pixels, depth = project(camera, drawn["means"])
    size = pixels.new_tensor(camera.size)
    seen = (depth > 0.1) & ((pixels > 0) & (pixels < size)).all(dim=1) & (drawn["opacities"] > 0.01)
    drawn = {name: x[seen] for name, x in drawn.items()}
    ellipses = project_gaussians(**drawn, camera=camera, backend=backend)
    means, scales, rotations, opacities = (x.double().cpu() for x in drawn.values())

    def centre(point: Tensor) -> Tensor:
        return project(CAMERA, point[None])[0][0]

    slopes = vmap(jacrev(centre))(means)  # [n, 2, 3]
    spread = slopes @ covariances(scales, rotations) @ slopes.transpose(1, 2)
    spread += BLUR * torch.eye(2, dtype=torch.float64)
    conics = spread.inverse().flatten(1)[:, [0, 1, 3]]
    reach = 2 * (opacities / LEAST_ALPHA).log()[:, None]
    extents = (reach * spread.diagonal(dim1=1, dim2=2)).sqrt()
    width = camera.width
    exact, z = project(CAMERA, means)
    got = ellipses.centres / width, ellipses.conics, ellipses.depth, ellipses.extents / width
    return largest_error(got, (exact / width, conics, z, extents / width))


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
    """How many numbers are shown, or have a gradient that is not finite."""
    depth = changed.get("depth", 1.0)
    shape = {
        "means": (CAMERA.centre + depth * CAMERA.c2w[:, 2])[None],
        "scales": torch.full((1, 3), changed.get("scale", 0.01)),
        "rotations": torch.tensor([[1.0, 0, 0, 0]]),
    }
    rest = {
        "opacities": torch.tensor([changed.get("opacity", 0.5)]),
        "camera": CAMERA,
    }
    shape, rest = placed((shape, rest), device, precision)
    learned = [x.requires_grad_() for x in shape.values()]
    found = project_gaussians(**shape, **rest, backend=backend)
    shown = found.centres.sum() + found.conics.sum()
    slopes = torch.autograd.grad(shown, learned)
    wrong = found.extents.count_nonzero()
    wrong += sum((~x.isfinite()).sum() for x in slopes)
    return float(wrong)

"""Backward warping: looks up the preceding picture at the points that the current picture shows.

A pixel of the current picture is unprojected to a point, and shows the colour of the preceding
picture there, interpolated bilinearly. Its depth is the bilinear mean over those of the four
nearest low-resolution pixels that have a depth at most `TOLERANCE` behind the nearest of the four:
the front surface hides what is behind it. Only the given cells are warped.
"""

from __future__ import annotations

import torch
from torch import Tensor

from bench.types import Camera, check_shape
from methods.kernels.dispatch import implementation

TOLERANCE = 0.02
"""A depth is averaged only if it is at most this far behind the nearest one, in scene units."""


def enlarge(depth: Tensor, cells: Tensor, scale: int, *, backend: str = "auto") -> Tensor:
    """Upsample the low-resolution z-depth `depth` [h, w], not finite where there is none, to the s
    x s pixels of `cells` [N] int64, row by row: [N, s^2], inf for none."""
    check_shape("depth", depth, None, None)
    check_shape("cells", cells, None)
    return implementation(__name__, backend, depth.device).enlarge(depth, cells, scale)


def warp(
    picture: Tensor,
    source: Camera,
    depth: Tensor,
    cells: Tensor,
    camera: Camera,
    scale: int,
    *,
    backend: str = "auto",
) -> tuple[Tensor, Tensor]:
    """Warp `picture` [H, W, C], seen by `source`, into some cells of the view of `camera`, whose
    size is a multiple of s; not differentiable.

    `depth` [N, s^2] is the z-depth of the pixels of `cells` [N] int64, as from `enlarge`; a pixel
    is valid only if its depth is positive and finite. Returns values [N, s^2, C], zero where
    invalid, and validity [N, s^2] in {0, 1}.
    """
    check_shape("picture", picture, source.height, source.width, None)
    check_shape("cells", cells, None)
    check_shape("depth", depth, len(cells), scale**2)
    return implementation(__name__, backend, picture.device).warp(
        picture, depth, cells, camera.width // scale, scale, source_from_camera(source, camera)
    )


def source_from_camera(source: Camera, camera: Camera) -> tuple[Tensor, Tensor]:
    """M [3, 3], m [3]: homogeneous source pixel = z M (u, v, 1) + m, in float64, on the device of
    the cameras, to which intrinsics are copied without waiting."""
    to, of = source.c2w.double(), camera.c2w.double()
    rotation = to[:, :3].T @ of[:, :3]
    offset = to[:, :3].T @ (of[:, 3] - to[:, 3])
    inside, outside = (
        torch.tensor([(c.fx, 0, c.cx), (0, c.fy, c.cy), (0, 0, 1)], dtype=torch.float64)
        for c in (source, camera)
    )
    inside = inside.to(to.device, non_blocking=True)
    return inside @ rotation @ outside.inverse().to(to.device, non_blocking=True), inside @ offset

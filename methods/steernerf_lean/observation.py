"""What the lean 2D renderer is shown: the preceding picture, and the field evaluated once a pixel,
at the surface that the low-resolution depth gives."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from bench.cameras import cast, project, unproject, within
from bench.types import Camera, Probe
from methods.rendering.compaction import kept_indices
from methods.rendering.field import CACHED_SAMPLES, Field, query
from methods.rendering.frame import FeatureFrame
from methods.rendering.occupancy import STEP
from methods.steernerf.buffer import Cloud, Points
from methods.steernerf.pipeline import View
from methods.steernerf_lean.cells import centres

OVERLAP_POINTS = 256  # at most, evenly spaced, to estimate how much of a frame another view shares
LAYER = 4 * STEP  # thickness, in scene units, of the layer that a sample of the surface stands for


@dataclass(frozen=True)
class LeanObservation:
    """What the lean 2D renderer is shown."""

    frame: FeatureFrame  # the present features, [h, w, K]
    background: Tensor  # [K] that they are composited on
    cells: Tensor  # [N] int64, the cells to draw
    surface: Points  # of `surface_points`; the index of every pixel of `cells` [N, s^2]
    history: tuple[Tensor, Tensor] | None  # the preceding picture, warped into `cells` [N, s^2, 3],
    # and where it is known [N, s^2]; None after a cold start and at L = 0
    backend: str  # of the kernels that the renderer calls


@dataclass(frozen=True)
class Kept(Cloud):
    """A preceding frame with the `picture` [H, W, 3] that the camera `full` saw."""

    picture: Tensor
    full: Camera


def overlap(cloud: Cloud, camera: Camera) -> Tensor:
    """Estimate the share of what a frame shows that `camera` can see: a scalar, 0 to 1.

    Every point inside the other picture counts (1 + cos t) / 2, where t is the angle between the
    two views of it: on a ball, the share of the visible disc that both cameras see. Occlusion is
    ignored.
    """
    cloud = cloud.expected()
    number = cloud.reliable.cumsum(dim=0)  # from 1
    every = (number[-1:] + OVERLAP_POINTS - 1) // OVERLAP_POINTS
    sampled = cloud.reliable & ((number - 1) % every.clamp(min=1) == 0)
    kept = kept_indices(sampled)
    points = cloud.points[kept]
    pixels, depth = project(camera, points)
    inside = sampled[kept] & (depth > 0) & within(pixels, camera.width, camera.height)
    here, there = (points - view.c2w[:3, 3] for view in (cloud.camera, camera))
    seen = (1 + functional.cosine_similarity(here, there, dim=1)) / 2
    return (torch.where(inside, seen, 0).sum() / sampled.sum()).nan_to_num(nan=0.0)


def surface_points(field: Field, depth: Tensor, cells: Tensor, view: View, probe: Probe) -> Points:
    """Sample features and opacity, [P, K + 1], at every pixel of `cells` [N] whose `depth` [N, s^2]
    is finite; differentiable in the field, not in the depth."""
    there = depth.isfinite().flatten()
    known = kept_indices(there)
    probe.count("surface_samples", len(known), view.full.width * view.full.height)
    field.count(probe, len(known), len(known))
    # A row at a time; `x[index]` goes number by number.
    pixels = centres(cells, view.low.width, view.scale).flatten(0, 1).index_select(0, known)
    near = torch.where(there, depth.flatten(), 0).index_select(0, known)
    points = unproject(view.full, pixels, near)
    # The pixels of a cell share the view direction of its middle.
    middles = cast(view.low, centres(cells, view.low.width, 1)[:, 0])
    encoded = field.encode_directions(middles.directions)
    size = CACHED_SAMPLES if depth.device.type == "cpu" else max(len(points), 1)
    found = []
    for some, cell in zip(points.split(size), (known // view.scale**2).split(size), strict=True):
        sigma, values = query(field, some, cell, encoded)
        alpha = -torch.expm1(-LAYER * sigma)  # of a layer of that thickness
        found.append(torch.cat((values, alpha[:, None]), dim=1))
    index = torch.full(depth.shape, -1, dtype=torch.int32, device=depth.device)
    number = torch.arange(len(points), dtype=torch.int32, device=depth.device)
    index.view(-1).index_copy_(0, known, torch.where(there.index_select(0, known), number, -1))
    return Points(torch.cat(found), index)

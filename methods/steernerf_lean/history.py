"""The preceding picture: kept with its frame, and warped into the present view."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from bench.cameras import project, within
from bench.types import Camera
from methods.rendering.compaction import kept_indices
from methods.steernerf.buffer import Cloud
from methods.steernerf.view import View
from methods.steernerf_lean.kernels.warp import warp
from methods.steernerf_lean.observation import Detail

OVERLAP_POINTS = 256
"""At most this many evenly spaced points estimate how much of a frame another view shares."""


@dataclass(frozen=True)
class Kept(Cloud):
    """A preceding frame with the `picture` [H, W, 3] that the camera `full` saw."""

    full: Camera
    picture: Tensor

    def warped(self, depth: Tensor, cells: Tensor, view: View, backend: str) -> Detail:
        """Warp the picture into `cells` of `view`, whose depth is `depth` [N, s^2]."""
        seen_by = self.picture, self.full
        return Detail(*warp(*seen_by, depth, cells, view.full, view.scale, backend=backend))


def overlap(cloud: Cloud, camera: Camera) -> Tensor:
    """Estimate the share of what a frame shows that `camera` can see: a scalar, 0 to 1.

    Every point inside the other picture counts (1 + cos t) / 2, where t is the angle between the
    two views of it: on a ball, the share of the visible disc that both cameras see. Occlusion is
    ignored. A frame that shows nothing gives 0.
    """
    clear = cloud.clear
    number = clear.cumsum(dim=0)  # from 1
    every = (number[-1:] + OVERLAP_POINTS - 1) // OVERLAP_POINTS
    sampled = clear & ((number - 1) % every.clamp(min=1) == 0)
    kept = kept_indices(sampled)
    points = cloud.points[kept]
    pixels, depth = project(camera, points)
    inside = sampled[kept] & (depth > 0) & within(pixels, camera.width, camera.height)
    here, there = (points - view.c2w[:3, 3] for view in (cloud.camera, camera))
    seen = (1 + functional.cosine_similarity(here, there, dim=1)) / 2
    share = torch.where(inside, seen, 0).sum() / sampled.sum()
    return share.nan_to_num(nan=0.0)

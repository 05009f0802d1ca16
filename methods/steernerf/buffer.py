"""The rendering buffer: preceding frames as points, reprojected into the present view."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from bench.cameras import pixel_grid, project, unproject
from bench.types import Camera
from methods.rendering.compaction import kept_indices
from methods.rendering.frame import FeatureFrame
from methods.steernerf.kernels.splat import splat
from methods.steernerf.options import Reprojection

SPLAT_ALPHA = 0.1
"""Minimum opacity of a pixel that becomes a point; the depth of a fainter pixel is unreliable."""


@dataclass(frozen=True)
class Cloud:
    """The non-empty pixels of a low-resolution frame, as points in the scene.

    On a GPU all pixels are kept (`rendering.compaction`): the points of empty ones have NaN
    coordinates, so that no view sees them. With depths "sum" (`Reprojection`) all are kept as well.

    Attributes:
        camera: the camera of the frame.
        source: [N] row-major index of each point's pixel.
        points: [N, 3] positions in scene units.
        values: [N, K] features.
        alpha: [N] opacity.
    """

    camera: Camera
    source: Tensor
    points: Tensor
    values: Tensor
    alpha: Tensor

    @classmethod
    def of(cls, frame: FeatureFrame, how: Reprojection) -> Cloud:
        """Unproject the pixels of `frame`."""
        alpha, depth = frame.alpha.flatten(), frame.depth.flatten()
        if how.depth == "sum":
            source = torch.arange(len(alpha), device=alpha.device)
            depth = torch.where(alpha > 0, depth.nan_to_num(posinf=0) * alpha, 0) + 1e-12
        else:
            clear = (alpha > SPLAT_ALPHA) & depth.isfinite()
            source = kept_indices(clear)
            depth = torch.where(clear, depth, torch.nan).index_select(0, source)
        camera = frame.camera
        centres = pixel_grid(camera.width, camera.height, alpha.device).index_select(0, source)
        if how.centres == "paper":
            centres = centres - 0.5
        values = frame.values.reshape(len(alpha), -1).index_select(0, source)
        points = unproject(camera, centres, depth)  # Eq. 6
        return cls(camera, source, points, values, alpha.index_select(0, source))

    def expected(self) -> Cloud:
        """Turn a cloud with depths sum w t into one with sum w t / sum w, without faint points."""
        clear = self.alpha > SPLAT_ALPHA
        kept, centre = kept_indices(clear), self.camera.c2w[:, 3]
        alpha = torch.where(clear, self.alpha, torch.nan)[kept]
        points = centre + (self.points[kept] - centre) / alpha[:, None]
        return Cloud(self.camera, self.source[kept], points, self.values[kept], alpha)

    def splat(self, camera: Camera, how: Reprojection, backend: str) -> tuple[Tensor, Tensor]:
        """Find the point that each pixel of `camera` shows.

        Returns:
            [H, W] int32 index of the point, -1 for none; and [N] z-depth of the points.
        """
        pixels, depth = project(camera, self.points)  # Eq. 7 at low resolution, Eq. 9 at full
        if how.centres == "paper":
            pixels = pixels + 0.5  # the paper centres pixel i at i
        size = camera.width, camera.height
        index = splat(pixels, depth, *size, rule=how.rule, backend=backend)  # Eq. 8, Eq. 10
        return index, depth

    def interval(self, camera: Camera, epsilon: float, how: Reprojection, backend: str) -> Tensor:
        """The z-depths [h, w, 2] between which each pixel of the low-resolution `camera` is
        sampled: D - epsilon and D + epsilon, or 0 and inf where no point lands."""
        index, depth = self.splat(camera, how, backend)
        depth = functional.pad(depth, (0, 1), value=torch.inf)[index.long()]  # -1: the padding
        near = torch.where(index >= 0, depth - epsilon, 0)
        return torch.stack((near, depth + epsilon), dim=-1)


Buffer = deque[Cloud]
"""The last L frames of a sequence, newest first; fewer after a cold start."""

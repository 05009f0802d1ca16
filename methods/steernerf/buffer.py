"""The rendering buffer: preceding frames as points, reprojected into the present view.

As in the release, pixels are unprojected through their corners, which shifts all of them by
s / 2 - 1/2 pixels, and of several points in a pixel the last one is shown.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn import functional

from bench.cameras import pixel_grid, project, unproject
from bench.types import Camera
from methods.rendering.frame import FeatureFrame
from methods.steernerf.kernels.splat import splat

RELIABLE_ALPHA = 0.1  # the expected depth of a pixel is reliable if its opacity is more than this


@dataclass(frozen=True)
class Points:
    """Features of points, and the point that each pixel shows."""

    values: Tensor  # [P, C]
    index: Tensor  # [...] int32, a row of `values`, -1 for none


@dataclass(frozen=True)
class Cloud:
    """The pixels of a low-resolution frame, as points in the scene. Their depth is the sum of w t:
    too near where alpha < 1, and at the camera where it is 0."""

    camera: Camera  # of the frame
    points: Tensor  # [N, 3] positions in scene units, row by row
    values: Tensor  # [N, K] features
    alpha: Tensor  # [N] opacity

    @classmethod
    def of(cls, frame: FeatureFrame) -> Cloud:
        """Unproject the pixels of `frame`."""
        camera, alpha = frame.camera, frame.alpha.flatten()
        depth = frame.depth.flatten().nan_to_num(posinf=0) * alpha  # sum w t again; inf where empty
        depth = torch.where(alpha > 0, depth, 0) + 1e-12
        corners = pixel_grid(camera.width, camera.height, alpha.device) - 0.5
        points = unproject(camera, corners, depth)  # Eq. 6
        return cls(camera, points, frame.values.flatten(0, 1), alpha)

    @property
    def reliable(self) -> Tensor:
        """[N] bool, which points have a reliable expected depth."""
        return self.alpha > RELIABLE_ALPHA

    def expected(self) -> Cloud:
        """The same with depths sum w t / sum w; no view sees points that are not reliable."""
        alpha, centre = torch.where(self.reliable, self.alpha, torch.nan), self.camera.c2w[:, 3]
        return replace(self, points=centre + (self.points - centre) / alpha[:, None])

    def interval(self, camera: Camera, epsilon: float, backend: str) -> Tensor:
        """The z-depths [h, w, 2] between which each pixel of the low-resolution `camera` is
        sampled: D - epsilon and D + epsilon, or 0 and inf where no point lands."""
        (index,), depth = _splat([self], camera, backend)
        depth = functional.pad(depth, (0, 1), value=torch.inf)[index.long()]  # -1: the padding
        near = torch.where(index >= 0, depth - epsilon, 0)
        return torch.stack((near, depth + epsilon), dim=-1)


def reproject(clouds: Sequence[Cloud], camera: Camera, channels: int, backend: str) -> Points:
    """Which of the `channels` features of `clouds` each pixel of `camera` shows: [L', H, W]."""
    index, _ = _splat(clouds, camera, backend)
    none = camera.c2w.new_empty(0, channels)
    return Points(torch.cat([none, *(cloud.values for cloud in clouds)]), index)


def _splat(clouds: Sequence[Cloud], camera: Camera, backend: str) -> tuple[Tensor, Tensor]:
    """The points of all `clouds` that each pixel of `camera` shows, one picture a cloud, and the
    z-depth of them all."""
    none = camera.c2w.new_empty(0, 3)
    points = torch.cat([none, *(cloud.points for cloud in clouds)])
    pixels, depth = project(camera, points)  # Eq. 7 at low resolution, Eq. 9 at full
    counts = [len(cloud.points) for cloud in clouds]
    size = camera.width, camera.height  # + 0.5: corners are rounded to the nearest one
    return splat(pixels + 0.5, depth, counts, *size, backend=backend), depth  # Eq. 8, Eq. 10


Buffer = deque[Cloud]
"""The last L frames of a sequence, newest first; fewer after a cold start."""

"""The rendering buffer: preceding frames as points, reprojected into the present view.

As in the release, pixels are unprojected through their corners, which shifts all of them by
s / 2 - 1/2 pixels, and of several points in a pixel the last one is shown.
"""

from collections import deque
from dataclasses import dataclass, replace
from typing import Self

import torch
from torch import Tensor

from bench.cameras import pixel_grid, project, unproject
from bench.types import Camera, TwoTensors
from methods.rendering.frame import FeatureFrame
from methods.steernerf.splat import splat

RELIABLE_ALPHA = 0.1  # the expected depth of a pixel is reliable if its opacity is more than this


@dataclass(frozen=True)
class Points:
    """Features of points, and the pixel of a view that shows each."""

    values: Tensor  # [N, K]
    pixel: Tensor  # [N] int64, row by row; one after the last for a point that no pixel shows


@dataclass(frozen=True)
class PointCloud:
    """The pixels of a low-resolution frame, as points in the scene. Their depth is the sum of w t:
    too near where alpha < 1, and at the camera where it is 0."""

    camera: Camera  # of the frame
    points: Tensor  # [N, 3] positions in scene units, row by row
    values: Tensor  # [N, K] features
    alpha: Tensor  # [N] opacity

    @classmethod
    def of(cls, frame: FeatureFrame) -> Self:
        """Unproject the pixels of `frame`."""
        camera, alpha = frame.camera, frame.alpha.flatten()
        depth = frame.depth.flatten().nan_to_num(posinf=0) * alpha  # sum w t again; inf where empty
        depth = torch.where(alpha > 0, depth, 0) + 1e-12
        corners = pixel_grid(*camera.size, alpha.device) - 0.5
        points = unproject(camera, corners, depth)  # Eq. 6
        return cls(camera, points, frame.values.flatten(0, 1), alpha)

    @property
    def reliable(self) -> Tensor:
        """[N] bool, which points have a reliable expected depth."""
        return self.alpha > RELIABLE_ALPHA

    def expected(self) -> Self:
        """The same with depths sum w t / sum w; no view sees points that are not reliable."""
        alpha, centre = torch.where(self.reliable, self.alpha, torch.nan), self.camera.centre
        return replace(self, points=centre + (self.points - centre) / alpha[:, None])

    def interval(self, low: Camera, epsilon: float) -> Tensor:
        """The z-depths [h, w, 2] between which each pixel of the low-resolution camera `low` is
        sampled: D - epsilon and D + epsilon, or 0 and inf where no point lands."""
        pixel, depth = self._reprojected(low)
        found = depth.new_zeros(low.width * low.height + 1, 2)
        found[:, 1] = torch.inf
        found[pixel] = torch.stack((depth - epsilon, depth + epsilon), dim=-1)  # Eq. 8
        return found[:-1].view(low.height, low.width, 2)

    def shown_in(self, full: Camera) -> Points:
        """The features that the camera `full`, at full resolution, shows of this frame (Eq. 10)."""
        return Points(self.values, self._reprojected(full)[0])

    def _reprojected(self, camera: Camera) -> TwoTensors:
        """The pixel of `camera` that shows each point, and the z-depth of each point there."""
        pixels, depth = project(camera, self.points)  # Eq. 7 at low resolution, Eq. 9 at full
        # + 0.5: corners are rounded to the nearest one
        return splat(pixels + 0.5, depth, *camera.size), depth


Buffer = deque[PointCloud]
"""The last L frames of a sequence, newest first; fewer after a cold start."""

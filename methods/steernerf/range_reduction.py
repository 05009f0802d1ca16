"""Range reduction: rays are sampled only near a reprojected depth (SteerNeRF, Section 3.2)."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from bench.types import Camera
from methods.steernerf.buffer import Cloud
from methods.steernerf.options import Reprojection


def depth_interval(
    cloud: Cloud, camera: Camera, epsilon: float, how: Reprojection, backend: str
) -> Tensor:
    """The z-depths [h, w, 2] between which each pixel of the low-resolution `camera` is sampled:
    D - epsilon and D + epsilon, or 0 and inf where no point of `cloud` lands."""
    index, depth = cloud.splat(camera, how, backend)  # Eq. 7, 8; Eq. 6 made the cloud
    reprojected = at_pixels(depth, index, torch.inf)  # D, t' -> t
    known = index >= 0
    return torch.stack(
        (
            torch.where(known, reprojected - epsilon, 0),
            torch.where(known, reprojected + epsilon, torch.inf),
        ),
        dim=-1,
    )


def at_pixels(values: Tensor, index: Tensor, otherwise: float) -> Tensor:
    """Look up `values` [N] at `index` [h, w]; `otherwise` where the index is -1."""
    return functional.pad(values, (0, 1), value=otherwise)[index.long()]  # -1 reads the padding

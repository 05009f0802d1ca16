"""What the lean 2D renderer is shown, and what it gives."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from methods.rendering.frame import FeatureFrame
from methods.steernerf.renderer import Points


@dataclass(frozen=True)
class Detail:
    """The pixels of N cells."""

    values: Tensor  # [N, s^2, C]
    valid: Tensor  # [N, s^2] where they are known


@dataclass(frozen=True)
class LeanObservation:
    """What the lean 2D renderer is shown.

    Attributes:
        frame: the present features, [h, w, K].
        background: [K] background that they are composited on.
        cells: [N] int64, the cells to draw; see `cells`.
        surface: features of the field at the surface of each pixel, which the low-resolution depth
            gives, with the opacity as the last of K + 1 channels; an index for every pixel of
            `cells` [N, s^2].
        history: the preceding picture, warped into `cells`; None after a cold start and at L = 0.
        backend: backend of the kernels that the renderer calls.
    """

    frame: FeatureFrame
    background: Tensor
    cells: Tensor
    surface: Points
    history: Detail | None
    backend: str


@dataclass(frozen=True)
class Drawing:
    """What the lean 2D renderer gives."""

    pictures: Tensor  # [B, H, W, 3]
    error: Tensor  # [N] estimated log of the mean squared error of each cell, picture by picture

"""What the lean 2D renderer is shown, and what it gives."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from methods.rendering.frame import FeatureFrame
from methods.steernerf.renderer import Points


@dataclass(frozen=True)
class Detail:
    """The pixels of N cells, `values` [N, s^2, C], and where they are known, `valid` [N, s^2]."""

    values: Tensor
    valid: Tensor


@dataclass(frozen=True)
class LeanObservation:
    """What the lean 2D renderer is shown.

    Attributes:
        frame: the present features, [h, w, K].
        background: [K] background that they are composited on.
        cells: [N] int64, the cells that may show matter; see `cells`.
        surface: features of the field at the surface of each pixel, which the low-resolution depth
            gives, with the opacity as the last of K + 1 channels; an index for every pixel of
            `cells` [N, s^2].
        history: the preceding picture, warped into `cells`; None if there is none, after a cold
            start or with L = 0.
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
    """What the lean 2D renderer gives.

    Attributes:
        pictures: [B, H, W, 3].
        error: [N] estimated error of all cells, observation by observation: the log of the mean
            squared error of their pixels.
    """

    pictures: Tensor
    error: Tensor

"""The 2D neural renderers: from low-resolution features to the picture (SteerNeRF, Section 3.4)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor, nn

from methods.volume import FeatureFrame


@dataclass(frozen=True)
class Reprojected:
    """Points in the present view: their `values` [N, K], and the `index` [H, W] of the point that
    each full-resolution pixel shows, -1 for none."""

    values: Tensor
    index: Tensor


@dataclass(frozen=True)
class Detail:
    """What is known pixel by pixel, in blocks: `values` [h, w, s^2, C], `valid` [h, w, s^2]."""

    values: Tensor
    valid: Tensor


@dataclass(frozen=True)
class Observation:
    """All that is known of a picture before it is drawn.

    Attributes:
        frame: the present features, [h, w, K].
        background: [K] that they are composited on.
        preceding: newest first; fewer than L after a cold start.
        history: the newest preceding picture; None after a cold start, or where it is not used.
        surface: features of the field where the low-resolution depth has the surface of a pixel,
            and their opacity as the last of K + 1; None where they are not used.
        phase: of the samples of `frame` against the centres of its pixels, in pixels of the
            picture.
        backend: of the kernels that a renderer calls.
    """

    frame: FeatureFrame
    background: Tensor
    preceding: Sequence[Reprojected]
    history: Detail | None
    surface: Reprojected | None = None
    phase: tuple[float, float] = (0.0, 0.0)
    backend: str = "auto"


class Renderer2d(nn.Module, ABC):
    """A network that turns observations into pictures."""

    @abstractmethod
    def forward(self, observations: Sequence[Observation]) -> Tensor:
        """Pictures [B, H, W, 3]."""

    @abstractmethod
    def base(self, observations: Sequence[Observation]) -> Tensor:
        """The pictures [B, H, W, 3] that the network corrects: RGB, enlarged."""

"""The 2D neural renderers: from low-resolution features to the picture (SteerNeRF, Section 3.4)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor, nn
from torch.nn import functional

from methods.volume import FeatureFrame

REACH = 2
"""Cells around matter that are still drawn: what is further from all that was seen is empty."""


@dataclass(frozen=True)
class Points:
    """Points in the present view: `values` [P, C] of each, and of the one that a pixel shows the
    `index` [...], int32, -1 for none."""

    values: Tensor
    index: Tensor


@dataclass(frozen=True)
class Detail:
    """What is known, pixel by pixel, of N cells: `values` [N, s^2, C], `valid` [N, s^2]."""

    values: Tensor
    valid: Tensor


@dataclass(frozen=True)
class Observation:
    """All that is known of a picture before it is drawn.

    A cell are the s x s pixels of the picture that a pixel of the present frame stands for.

    Attributes:
        frame: the present features, [h, w, K].
        background: [K] that they are composited on.
        preceding: newest first, with an index for every pixel [H, W]; fewer than L after a cold
            start.
        cells: [N] int64, the cells in which there may be anything, counted row by row; see
            `cells_at_matter`.
        history: the newest preceding picture in `cells`; None after a cold start, or where it is
            not used.
        surface: features of the field where the low-resolution depth has the surface of a pixel,
            and their opacity as the last of K + 1, with an index for every pixel of `cells`
            [N, s^2]; None where they are not used.
        phase: of the samples of `frame` against the centres of its pixels, in pixels of the
            picture.
        backend: of the kernels that a renderer calls.
    """

    frame: FeatureFrame
    background: Tensor
    preceding: Sequence[Points]
    cells: Tensor
    history: Detail | None
    surface: Points | None = None
    phase: tuple[float, float] = (0.0, 0.0)
    backend: str = "auto"


def cells_at_matter(alpha: Tensor, preceding: Sequence[Points]) -> Tensor:
    """The cells [N] within `REACH` of anything seen: in the present frame, of opacity `alpha`
    [h, w], or in a preceding one."""
    height, width = alpha.shape
    some = alpha > 0
    for points in preceding:
        scale = points.index.shape[0] // height
        shown = (points.index >= 0).view(height, scale, width, scale)
        some = some | shown.any(dim=3).any(dim=1)
    size = 2 * REACH + 1
    near = functional.max_pool2d(some[None].float(), size, stride=1, padding=REACH)
    return near.flatten().nonzero().squeeze(1)


class Renderer2d(nn.Module, ABC):
    """A network that turns observations into pictures."""

    @abstractmethod
    def forward(self, observations: Sequence[Observation]) -> Tensor:
        """Pictures [B, H, W, 3]."""

    @abstractmethod
    def base(self, observations: Sequence[Observation]) -> Tensor:
        """The pictures [B, H, W, 3] that the network corrects: RGB, enlarged."""

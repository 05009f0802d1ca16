"""The 2D neural renderers: from low-resolution features to the picture (SteerNeRF, Section 3.3)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from torch import Tensor, nn

from bench.types import NullProbe, Probe
from methods.engines.network import Network
from methods.rendering.frame import FeatureFrame
from methods.steernerf_lean.cells import cells_near, largest_in_cell


@dataclass(frozen=True)
class Points:
    """Features of points, `values` [P, C], and the row of `values` that each pixel shows: `index`
    [...], int32, -1 for none."""

    values: Tensor
    index: Tensor


@dataclass(frozen=True)
class Detail:
    """The pixels of N cells, `values` [N, s^2, C], and where they are known, `valid` [N, s^2]."""

    values: Tensor
    valid: Tensor


@dataclass(frozen=True)
class Observation:
    """Everything that a 2D renderer is given to draw a picture.

    Attributes:
        frame: the present features, [h, w, K].
        background: [K] background that they are composited on.
        preceding: features of the preceding frames, newest first, with an index for every pixel
            [H, W]; fewer than L after a cold start.
        cells: [N] int64, the cells that may show matter; see `beyond.cells`.
        history: the newest preceding picture, warped into `cells`; None after a cold start, or if
            it is not used.
        surface: features of the field at the surface of each pixel, which the low-resolution depth
            gives, with the opacity as the last of K + 1 channels; an index for every pixel of
            `cells` [N, s^2]. None if they are not used.
        backend: backend of the kernels that a renderer calls.
    """

    frame: FeatureFrame
    background: Tensor
    preceding: Sequence[Points]
    cells: Tensor
    history: Detail | None
    surface: Points | None = None
    backend: str = "auto"


def cells_at_matter(alpha: Tensor, preceding: Sequence[Points]) -> Tensor:
    """Find the cells [N] near matter in the present frame, of opacity `alpha` [h, w], or in a
    preceding one. The host waits for a GPU."""
    near = near_matter(alpha > 0, [points.index for points in preceding])
    return near.flatten().nonzero().squeeze(1)


def near_matter(seen: Tensor, indices: Sequence[Tensor]) -> Tensor:
    """Which cells [h, w] bool are near matter: `seen` [h, w] in the present frame, or shown by the
    points of a preceding frame, given by its `indices` [H, W]."""
    for index in indices:
        scale = index.shape[0] // len(seen)
        seen = seen | (largest_in_cell(index, scale) >= 0)
    return cells_near(seen)


@dataclass(frozen=True)
class Drawing:
    """The output of a 2D renderer.

    Attributes:
        pictures: [B, H, W, 3].
        error: [N] estimated error of all cells, observation by observation: the log of the mean
            squared error of their pixels. None: the renderer does not estimate it.
    """

    pictures: Tensor
    error: Tensor | None = None


UNWATCHED = NullProbe()


class Renderer2d(nn.Module, ABC):
    """Turns observations into pictures with a network.

    Attributes:
        scale: s.
        draws_cells: whether it draws only the cells of an observation, not the whole picture.
        estimates_error: whether it estimates the error of each cell.
        reads_details: whether it reads the preceding picture and the field at the surface.
        network: the trainable network.
        engine: computes the output of `network` in its place, if set; see `methods.engines`.
    """

    scale: int
    draws_cells = False
    estimates_error = False
    reads_details = False
    network: Network
    engine: Callable[..., tuple[Tensor, ...]] | None = None

    def run(self, probe: Probe, *inputs: Tensor) -> tuple[Tensor, ...]:
        """Compute the network's output, with the engine if there is one."""
        probe.count("products", self.network.products(*inputs))
        with probe.stage("network"):
            return (self.engine or self.network)(*inputs)

    @abstractmethod
    def forward(self, observations: Sequence[Observation], probe: Probe = UNWATCHED) -> Drawing:
        """Draw all observations."""

    @abstractmethod
    def base(self, observations: Sequence[Observation]) -> Tensor:
        """The pictures [B, H, W, 3] that the network corrects: RGB, enlarged."""

"""The 2D neural renderers: from low-resolution features to the picture (SteerNeRF, Section 3.3)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from torch import Tensor, nn

from bench.types import NullProbe, Probe
from methods.engines.network import Network
from methods.rendering.frame import FeatureFrame
from methods.steernerf.beyond.cells import cells_near, largest_in_cell


@dataclass(frozen=True)
class Points:
    """Features `values` [P, C] of points, and for each pixel the row of `values` that it shows:
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

    Attributes:
        frame: the present features, [h, w, K].
        background: [K] that they are composited on.
        preceding: newest first, with an index for every pixel [H, W]; fewer than L after a cold
            start.
        cells: [N] int64, the cells in which there may be anything; see `beyond.cells`.
        history: the newest preceding picture in `cells`; None after a cold start, or where it is
            not used.
        surface: features of the field where the low-resolution depth has the surface of a pixel,
            and their opacity as the last of K + 1, with an index for every pixel of `cells`
            [N, s^2]; None where they are not used.
        backend: of the kernels that a renderer calls.
    """

    frame: FeatureFrame
    background: Tensor
    preceding: Sequence[Points]
    cells: Tensor
    history: Detail | None
    surface: Points | None = None
    backend: str = "auto"


def cells_at_matter(alpha: Tensor, preceding: Sequence[Points]) -> Tensor:
    """The cells [N] near anything seen: in the present frame, of opacity `alpha` [h, w], or in a
    preceding one. The host waits for a GPU."""
    near = near_matter(alpha > 0, [points.index for points in preceding])
    return near.flatten().nonzero().squeeze(1)


def near_matter(seen: Tensor, indices: Sequence[Tensor]) -> Tensor:
    """Which cells are near anything, [h, w] bool: where the present frame has `seen` it, [h, w], or
    preceding ones show it, of whose points the `indices` [H, W] tell."""
    for index in indices:
        scale = index.shape[0] // len(seen)
        seen = seen | (largest_in_cell(index, scale) >= 0)
    return cells_near(seen)


@dataclass(frozen=True)
class Drawing:
    """What a 2D renderer makes of observations.

    Attributes:
        pictures: [B, H, W, 3].
        error: [N] estimated error of all cells, one observation after the other: the log of the
            mean squared error of their pixels. None: the renderer does not estimate it.
    """

    pictures: Tensor
    error: Tensor | None = None


UNWATCHED = NullProbe()


class Renderer2d(nn.Module, ABC):
    """Turns observations into pictures, with the help of a network.

    Attributes:
        scale: s.
        draws_cells: it draws the cells of an observation alone; otherwise the whole picture.
        estimates_error: it says which cells of its pictures may be wrong.
        reads_details: it reads the preceding picture and the field at the surface.
        network: what is learned.
        engine: computes what the network does, in its place; see `methods.engines`.
    """

    scale: int
    draws_cells = False
    estimates_error = False
    reads_details = False
    network: Network
    engine: Callable[..., tuple[Tensor, ...]] | None = None

    def run(self, probe: Probe, *inputs: Tensor) -> tuple[Tensor, ...]:
        """What the network makes of its inputs."""
        probe.count("products", self.network.products(*inputs))
        with probe.stage("network"):
            return (self.engine or self.network)(*inputs)

    @abstractmethod
    def forward(self, observations: Sequence[Observation], probe: Probe = UNWATCHED) -> Drawing:
        """Draw all of them."""

    @abstractmethod
    def base(self, observations: Sequence[Observation]) -> Tensor:
        """The pictures [B, H, W, 3] that the network corrects: RGB, enlarged."""

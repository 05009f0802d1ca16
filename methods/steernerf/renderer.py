"""The 2D neural renderers: from low-resolution features to the picture (SteerNeRF, Section 3.4)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from torch import Tensor, nn

from bench.types import NullProbe, Probe
from methods.engines import Network
from methods.rendering.batch import FeatureFrame
from methods.steernerf.beyond.cells import cells_near, largest_in_cell


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

    Attributes:
        frame: the present features, [h, w, K].
        background: [K] that they are composited on.
        preceding: newest first, with an index for every pixel [H, W]; fewer than L after a cold
            start.
        cells: [N] int64, the cells in which there may be anything; see `methods.steernerf.beyond.cells`.
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
    """The cells [N] near anything seen: in the present frame, of opacity `alpha` [h, w], or in a
    preceding one."""
    seen = alpha > 0
    for points in preceding:
        scale = points.index.shape[0] // len(alpha)
        seen = seen | (largest_in_cell(points.index, scale) >= 0)
    return cells_near(seen)


@dataclass(frozen=True)
class Drawing:
    """What a 2D renderer makes of observations.

    Attributes:
        pictures: [B, H, W, 3].
        doubt: [N] of all cells of the observations, one observation after the other: log of the
            mean squared error that is expected there. None: the renderer does not say.
    """

    pictures: Tensor
    doubt: Tensor | None = None


UNWATCHED = NullProbe()


class Renderer2d(nn.Module, ABC):
    """Turns observations into pictures, with the help of a network.

    Attributes:
        scale: s.
        doubts: it says where its pictures may be wrong.
        shifts: it draws frames whose samples lie beside the centres of their pixels.
        network: what is learned.
        engine: computes what the network does, in its place; see `methods.engines`.
    """

    scale: int
    doubts = False
    shifts = False
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


def check_size(name: str, got: int, least: int, most: int) -> None:
    """Refuse, with a ValueError, a size that is not of `least` to `most`."""
    if not least <= got <= most:
        raise ValueError(f"{name}: expected {least} to {most}, got {got}")


def check_refined(name: str, share: float, renderer: Renderer2d) -> None:
    """Refuse, with a ValueError, a `share` of cells to be refined that `renderer` cannot choose."""
    if share and not renderer.doubts:
        raise ValueError(
            f"{name}: {type(renderer).__name__} does not say where it may be wrong, expected 0, "
            f"got {share}"
        )

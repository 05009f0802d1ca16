"""The interface of a 2D neural renderer: from reprojected features to the picture (Section 3.3)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from torch import Tensor, nn

from bench.types import NullProbe, Probe
from methods.engines.network import Network
from methods.rendering.frame import FeatureFrame

UNWATCHED = NullProbe()


@dataclass(frozen=True)
class Points:
    """Features of points, `values` [P, C], and the row of `values` that each pixel shows: `index`
    [...], int32, -1 for none."""

    values: Tensor
    index: Tensor


@dataclass(frozen=True)
class Observation:
    """What the 2D renderer is shown.

    Attributes:
        frame: the present features F, [h, w, K].
        preceding: features of the preceding frames, newest first, with an index for every pixel
            [H, W]; fewer than L after a cold start.
        backend: backend of the kernels that a renderer calls.
    """

    frame: FeatureFrame
    preceding: Sequence[Points]
    backend: str


class Renderer2d(nn.Module, ABC):
    """Turns observations into pictures with a network.

    Attributes:
        network: the trainable network.
        engine: computes the output of `network` in its place, if set; see `methods.engines`.
    """

    network: Network
    engine: Callable[..., tuple[Tensor, ...]] | None = None

    def run(self, probe: Probe, *inputs: Tensor) -> tuple[Tensor, ...]:
        """Compute the network's output, with the engine if there is one."""
        probe.count("products", self.network.products(*inputs))
        with probe.stage("network"):
            return (self.engine or self.network)(*inputs)

    @abstractmethod
    def forward(self, observations: Sequence[Any], probe: Probe = UNWATCHED) -> Any:
        """Draw all observations: pictures [B, H, W, 3], or what a subclass says (Eq. 11)."""

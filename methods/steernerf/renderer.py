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
    """Features of points, and the point that each pixel shows."""

    values: Tensor  # [P, C]
    index: Tensor  # [...] int32, a row of `values`, -1 for none


@dataclass(frozen=True)
class Observation:
    """What the 2D renderer is shown."""

    frame: FeatureFrame  # the present features F, [h, w, K]
    preceding: Sequence[Points]  # features of preceding frames, newest first, indices [H, W]; at
    # most L, fewer after a cold start
    backend: str  # of the kernels that a renderer calls


class Renderer2d(nn.Module, ABC):
    """Turns observations into pictures with a `network`, which an `engine` computes if set."""

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

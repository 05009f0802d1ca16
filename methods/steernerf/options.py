"""Settings that stage 2 trains for (`Model`), and settings chosen afterwards (`Rendering`)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from methods.kernels.composite import check_stop
from methods.rendering.occupancy import STEP
from methods.rendering.sampling import Sampling, check_step

SIZES = {"channels": (3, 256), "frames": (0, 64), "scale": (1, 64)}
"""Minimum and maximum of K, L and s."""


@dataclass(frozen=True)
class Model:
    """What a SteerNeRF is trained for: changing any of it requires training again."""

    channels: int  # K, number of features of the field; the first three are RGB
    frames: int  # L, number of preceding frames
    scale: int  # s; the field is rendered at 1/s of the resolution
    step: float  # ray-marching step at low resolution, in diagonals of the cube / 1024
    stop: float  # transmittance at which a ray ends
    feature_background: float  # what features beyond RGB are composited on

    def __post_init__(self) -> None:
        for name, (least, most) in SIZES.items():
            check_size(name, getattr(self, name), least, most)
        check_step("step", self.step)
        check_stop(self.stop)


@dataclass(frozen=True)
class RangeReduction:
    """Where along a ray to sample, given the depth D of the newest preceding frame (Section 3.2).

    Attributes:
        mode: "off": everywhere. "paper": within `epsilon` of the depth reprojected onto the pixel.
        epsilon: margin on either side of the depth, scene units along z.
        depth: which D is reprojected: "sum", the sum of w t as the release renders it, or
            "expected", the same divided by the opacity. The two differ at silhouettes.
    """

    mode: Literal["off", "paper"]
    epsilon: float
    depth: Literal["sum", "expected"]

    def __post_init__(self) -> None:
        if not self.epsilon > 0:
            raise ValueError(f"range.epsilon: expected more than 0, got {self.epsilon}")


EVERYWHERE = RangeReduction("off", epsilon=1.0, depth="sum")
"""No range reduction; `epsilon` and `depth` say nothing."""


@dataclass(frozen=True)
class Skips:
    """Work to skip because no picture shows it; switch one off to measure what it saves."""

    empty: bool  # samples in empty cells, and rays that meet no other cells
    hidden: bool  # samples behind a transmittance of `Rendering.stop`


@dataclass(frozen=True)
class Rendering:
    """Settings chosen after training: one training serves every choice."""

    step: float  # ray-marching step at low resolution, in diagonals of the cube / 1024
    stop: float  # transmittance at which a ray ends
    range: RangeReduction
    skip: Skips

    def __post_init__(self) -> None:
        check_step("step", self.step)
        check_stop(self.stop)

    @property
    def sampling(self) -> Sampling:
        """How rays at low resolution are marched."""
        return Sampling(step=self.step * STEP, stop=self.stop if self.skip.hidden else 0.0)


def check_size(name: str, got: int, least: int, most: int) -> None:
    """Raise ValueError unless `got` lies between `least` and `most`."""
    if not least <= got <= most:
        raise ValueError(f"{name}: expected {least} to {most}, got {got}")

"""Settings that stage 2 trains for (`Model`), and settings chosen afterwards (`Rendering`)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from methods.kernels.composite import check_stop
from methods.rendering.march import March, check_step
from methods.rendering.occupancy import STEP

SIZES = {"channels": (3, 256), "frames": (0, 64), "scale": (1, 64)}
"""Minimum and maximum of K, L and s."""


@dataclass(frozen=True)
class Reprojection:
    """How a frame is reprojected into another view; the release's choices are marked (paper).

    Attributes:
        rule: which of several points a pixel shows, the "nearest", or the "last" written (paper).
        centres: "exact", or "paper" (paper): pixels are unprojected through their corner, a
            constant offset of s / 2 - 1/2 pixels that the 2D renderer has to learn.
        depth: the "expected" depth of the ray, or the "sum" of w t (paper), which is too near where
            alpha < 1 and turns empty pixels into points at the camera.
    """

    rule: Literal["nearest", "last"]
    centres: Literal["exact", "paper"]
    depth: Literal["expected", "sum"]


@dataclass(frozen=True)
class Model:
    """What a SteerNeRF is trained for: changing any of it requires training again.

    Attributes:
        channels: K, number of features of the field; the first three are RGB.
        frames: L, number of preceding frames.
        scale: s; the field is rendered at 1/s of the resolution.
        step: ray-marching step at low resolution, in diagonals of the cube / 1024; stage 2 trains
            the field for it.
        stop: transmittance at which a ray ends.
        reprojection: how preceding frames are reprojected into the present view.
        feature_background: what the features beyond RGB are composited on. 1/2 is the value of an
            untrained feature.
    """

    channels: int
    frames: int
    scale: int
    step: float
    stop: float
    reprojection: Reprojection
    feature_background: float

    def __post_init__(self) -> None:
        for name, (least, most) in SIZES.items():
            check_size(name, getattr(self, name), least, most)
        check_step("step", self.step)
        check_stop(self.stop)


@dataclass(frozen=True)
class RangeReduction:
    """Where along a ray to sample, given the depth of the newest preceding frame (Section 3.2).

    Attributes:
        mode: "off": everywhere. "paper": within `epsilon` of the depth reprojected onto the pixel.
        epsilon: margin on either side of the depth, scene units along z.
        depth: which depth D is reprojected: "sum", the sum of w t as the release renders it, or
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
    """Work to skip because no picture shows it; switch one off to measure what it saves.

    Attributes:
        empty: samples in empty cells, and rays that meet no other cells.
        hidden: samples behind a transmittance of `Rendering.stop`.
    """

    empty: bool
    hidden: bool


@dataclass(frozen=True)
class Rendering:
    """Settings chosen after training: one training serves every choice.

    Attributes:
        step: ray-marching step at low resolution, in diagonals of the cube / 1024.
        stop: transmittance at which a ray ends.
        range: where rays are sampled.
        skip: which work is skipped.
    """

    step: float
    stop: float
    range: RangeReduction
    skip: Skips

    def __post_init__(self) -> None:
        check_step("step", self.step)
        check_stop(self.stop)

    @property
    def march(self) -> March:
        """How rays at low resolution are marched."""
        return March(step=self.step * STEP, stop=self.stop if self.skip.hidden else 0.0)


def check_size(name: str, got: int, least: int, most: int) -> None:
    """Raise ValueError unless `got` lies between `least` and `most`."""
    if not least <= got <= most:
        raise ValueError(f"{name}: expected {least} to {most}, got {got}")

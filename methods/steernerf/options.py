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
class Reprojection:
    """How a frame is reprojected into another view; the release's choices are marked (paper).

    Attributes:
        rule: which of several points a pixel shows, the "nearest", or the "last" written (paper).
        centres: "exact", or "paper" (paper): pixels are unprojected through their corner, a
            constant offset of s / 2 - 1/2 pixels that the 2D renderer has to learn.
        depth: the "expected" depth of the ray, or the "sum" of w t (paper), which is too near where
            alpha < 1 and turns empty pixels into points at the camera.
    """

    rule: Literal["nearest", "last"] = "nearest"
    centres: Literal["exact", "paper"] = "exact"
    depth: Literal["expected", "sum"] = "expected"


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
        history: whether the preceding picture is reprojected as well (not in the paper).
        surface: whether the field is also evaluated once per pixel at full resolution, at the
            surface that the low-resolution depth gives (not in the paper).
    """

    channels: int
    frames: int
    scale: int
    step: float
    stop: float
    reprojection: Reprojection
    feature_background: float
    history: bool
    surface: bool

    def __post_init__(self) -> None:
        for name, (least, most) in SIZES.items():
            check_size(name, getattr(self, name), least, most)
        check_step("step", self.step)
        check_stop(self.stop)


@dataclass(frozen=True)
class RangeReduction:
    """Where along a ray to sample, given the depth of the newest preceding frame.

    Attributes:
        mode: "off": everywhere. "paper": within `epsilon` of the depth reprojected onto the pixel
            (SteerNeRF, Section 3.2). "window": within `epsilon` of the depths reprojected onto its
            3 x 3 neighbourhood. A ray ends once it has the opacity of these points; if it does not
            reach it, it continues behind the window. At a depth edge the whole ray is marched.
        epsilon: margin on either side of the depth, scene units along z.
        depth: which depth D is reprojected: "sum", the sum of w t as the release renders it, or
            "expected", the same divided by the opacity. The two differ at silhouettes.
    """

    mode: Literal["off", "paper", "window"] = "off"
    epsilon: float = 0.03
    depth: Literal["sum", "expected"] = "expected"

    def __post_init__(self) -> None:
        if not self.epsilon > 0:
            raise ValueError(f"range.epsilon: expected more than 0, got {self.epsilon}")


@dataclass(frozen=True)
class Skips:
    """Work to skip because no picture shows it; switch one off to measure what it saves.

    Attributes:
        empty: samples in empty cells, and rays that meet no other cells.
        hidden: samples behind a transmittance of `Rendering.stop`.
        background: cells that are not near matter.
    """

    empty: bool = True
    hidden: bool = True
    background: bool = True


@dataclass(frozen=True)
class Rendering:
    """Settings chosen after training: one training serves every choice.

    Attributes:
        step: ray-marching step at low resolution, in diagonals of the cube / 1024.
        stop: transmittance at which a ray ends.
        range: where rays are sampled.
        overlap: a preceding frame is dropped if the present view sees less than this share of what
            the frame shows; see `buffer.Cloud.overlap`.
        refined: share of the cells whose pixels the field renders instead: those with the largest
            estimated error (not in the paper).
        refined_step: ray-marching step in these cells, in the same unit.
        skip: which work is skipped.
    """

    step: float
    stop: float
    range: RangeReduction
    overlap: float
    refined: float
    refined_step: float
    skip: Skips

    def __post_init__(self) -> None:
        check_step("step", self.step)
        check_step("refined_step", self.refined_step)
        for name in ("overlap", "refined"):
            if not 0 <= (share := getattr(self, name)) <= 1:
                raise ValueError(f"{name}: expected a share of 0 to 1, got {share}")
        check_stop(self.stop)

    @classmethod
    def in_training(cls, model: Model, refined: float, refined_step: float) -> Rendering:
        """How `model` is rendered during training: without range reduction, so that one training
        serves all choices; a share `refined` of the cells is refined, with steps of
        `refined_step`."""
        return cls(
            model.step,
            model.stop,
            RangeReduction(mode="off"),
            overlap=0.0,
            refined=refined,
            refined_step=refined_step,
            skip=Skips(),
        )

    @property
    def sampling(self) -> Sampling:
        """How rays at low resolution are marched."""
        return self._sampling(self.step)

    @property
    def refined_sampling(self) -> Sampling:
        """How rays of refined cells are marched."""
        return self._sampling(self.refined_step)

    def _sampling(self, step: float) -> Sampling:
        return Sampling(step=step * STEP, stop=self.stop if self.skip.hidden else 0.0)


def check_size(name: str, got: int, least: int, most: int) -> None:
    """Raise ValueError unless `got` lies between `least` and `most`."""
    if not least <= got <= most:
        raise ValueError(f"{name}: expected {least} to {most}, got {got}")

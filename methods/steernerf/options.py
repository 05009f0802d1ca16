"""What of a frame is trained for (`Model`), and what is chosen afterwards (`Rendering`)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from methods.kernels.composite import check_stop
from methods.rendering.march import March, check_step
from methods.rendering.occupancy import STEP

SIZES = {"channels": (3, 256), "frames": (0, 64), "scale": (1, 64)}
"""K, L and s that a model may have: from, to."""


@dataclass(frozen=True)
class Reprojection:
    """How a frame is brought into another view; the release's values are marked (paper).

    Attributes:
        rule: which point a pixel shows, the "nearest", or the "last" written (paper).
        centres: "exact", or "paper" (paper): unprojected through the corner of a pixel, a constant
            offset of s / 2 - 1/2 pixels that the 2D renderer has to learn.
        depth: "expected" termination, or the "sum" of w t (paper): too near where alpha < 1; empty
            pixels become points at the camera.
    """

    rule: Literal["nearest", "last"] = "nearest"
    centres: Literal["exact", "paper"] = "exact"
    depth: Literal["expected", "sum"] = "expected"


@dataclass(frozen=True)
class Model:
    """What a SteerNeRF is trained for: a change of any of it is another training.

    Attributes:
        channels: K, features of the field; the first three are RGB.
        frames: L, preceding frames.
        scale: s, the field is rendered at 1/s of the resolution.
        step: of the rays at low resolution, in diagonals of the cube / 1024; stage 2 trains the
            field for it.
        stop: transmittance at which a ray ends.
        reprojection: how preceding frames are brought into the present view.
        feature_background: what the features beyond RGB are composited on. 1/2 is what an
            untrained feature is everywhere.
        history: the preceding picture is reprojected, too (not in the paper).
        surface: the field is also evaluated once a pixel at full resolution, where the
            low-resolution depth has the surface (not in the paper).
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
    """Where along a ray to look for a surface, given the depth of the newest preceding frame.

    Attributes:
        mode: "off": everywhere. "paper": within `epsilon` of the depth reprojected onto the pixel
            (SteerNeRF, Section 3.2). "window": within `epsilon` of the depths reprojected onto its
            3 x 3 neighbourhood. A ray ends at the opacity they had; if it does not reach it, it
            continues behind the window. At a depth edge the whole ray is marched.
        epsilon: scene units along z.
        depth: which D it is that is reprojected: "sum", sum w t as the release renders it, or
            "expected", divided by the opacity. The two differ at silhouettes.
    """

    mode: Literal["off", "paper", "window"] = "off"
    epsilon: float = 0.03
    depth: Literal["sum", "expected"] = "expected"

    def __post_init__(self) -> None:
        if not self.epsilon > 0:
            raise ValueError(f"range.epsilon: expected more than 0, got {self.epsilon}")


@dataclass(frozen=True)
class Skips:
    """What is not computed because no picture shows it; switched off, to see what that saves.

    Attributes:
        empty: samples where the field holds nothing, and rays that meet nothing else.
        hidden: samples behind a transmittance of `Rendering.stop`.
        background: cells near which nothing is seen.
    """

    empty: bool = True
    hidden: bool = True
    background: bool = True


@dataclass(frozen=True)
class Rendering:
    """What is chosen after the training: one training serves every choice.

    Attributes:
        step: of the rays at low resolution, in diagonals of the cube / 1024.
        stop: transmittance at which a ray ends.
        range: where rays look for a surface.
        overlap: a preceding frame that shares less than this of what it shows with the present view
            is not used; see `buffer.Cloud.overlap`.
        refined: share of the cells whose pixels are rendered by the field after all: those with the
            largest estimated error (not in the paper).
        refined_step: of the rays there.
        skip: what is not computed.
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
        """How `model` is rendered while it is trained: rays look everywhere, so that one training
        serves all choices; a share `refined` of the cells is refined, in steps of
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
    def march(self) -> March:
        """Of the rays at low resolution."""
        return self._march(self.step)

    @property
    def refined_march(self) -> March:
        """Of the rays of refined cells."""
        return self._march(self.refined_step)

    def _march(self, step: float) -> March:
        return March(step=step * STEP, stop=self.stop if self.skip.hidden else 0.0)


def check_size(name: str, got: int, least: int, most: int) -> None:
    """Refuse, with a ValueError, a size that is not of `least` to `most`."""
    if not least <= got <= most:
        raise ValueError(f"{name}: expected {least} to {most}, got {got}")

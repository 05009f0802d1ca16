"""What a frame of the pipeline is made of, and what of it a training depends on."""

from __future__ import annotations

from dataclasses import dataclass, replace

from methods.kernels.composite import STOP, check_stop
from methods.kernels.encode import HashGrid
from methods.steernerf.buffer import Reprojection
from methods.steernerf.range_reduction import RangeReduction
from methods.steernerf.refresh import Refresh
from methods.steernerf.renderer import Renderer2d, check_refined, check_size

SIZES = {"channels": (3, 256), "frames": (0, 64), "scale": (1, 64)}
"""K, L and s that a pipeline may have: from, to."""


@dataclass(frozen=True)
class Skips:
    """What is not computed because no picture shows it; switched off, to see what that saves.

    Attributes:
        empty: samples where the field holds nothing, and rays that meet nothing else.
        hidden: samples behind a transmittance of `PipelineOptions.stop`.
        background: cells near which nothing is seen.
    """

    empty: bool = True
    hidden: bool = True
    background: bool = True


@dataclass(frozen=True)
class PipelineOptions:
    """What a frame is made of.

    Attributes:
        channels: K, features of the field; the first three are RGB.
        frames: L, preceding frames.
        scale: s, the field is rendered at 1/s of the resolution.
        range: where rays look for a surface. It is not trained for, and can be chosen afterwards.
        refresh: which low-resolution rays are not rendered anew. It is not trained for, either.
        reprojection: how preceding frames are brought into the present view.
        history: the preceding picture is reprojected, too.
        surface: the field is looked at once a pixel at full resolution, too, where the
            low-resolution depth has the surface.
        overlap: a preceding frame of which the present view shares less than this is not brought
            into it, neither its features nor its depth or picture; see `Cloud.overlap`. It can be
            chosen after the training.
        jitter: the samples of the low-resolution grid move from frame to frame, so that
            preceding frames carry samples of other places.
        feature_background: what the features beyond RGB are composited on. 1/2 is what an
            untrained feature is everywhere.
        stop: transmittance at which a ray ends.
        steps: length of a ray-marching step at low resolution, in those of stage 1: stage 2 teaches
            the field to do with longer ones.
        levels: of the field's grid that low-resolution rays read, the coarsest first: cells of the
            others may be far smaller than their pixels. None: all.
        refined: share of the cells whose pixels are rendered by the field after all, those that
            the 2D renderer doubts most. It can be chosen after the training, too.
        refined_steps: length of a ray-marching step there. It can be chosen after the training,
            which takes steps as short as those of stage 1: at full resolution longer ones show.
        skip: what is not computed. Nor is it trained for.
    """

    channels: int = 6
    frames: int = 2
    scale: int = 4
    range: RangeReduction = RangeReduction("off")
    refresh: Refresh = Refresh()
    reprojection: Reprojection = Reprojection()
    history: bool = True
    surface: bool = True
    overlap: float = 0.0
    jitter: bool = False
    feature_background: float = 0.5
    stop: float = STOP
    steps: float = 1.0
    levels: int | None = None
    refined: float = 0.0
    refined_steps: float = 1.0
    skip: Skips = Skips()

    def __post_init__(self) -> None:
        for name, (least, most) in SIZES.items():
            check_size(name, getattr(self, name), least, most)
        for name in ("steps", "refined_steps"):
            if not (length := getattr(self, name)) > 0:
                raise ValueError(f"{name}: expected a length of more than 0, got {length}")
        for name in ("overlap", "refined"):
            if not 0 <= (share := getattr(self, name)) <= 1:
                raise ValueError(f"{name}: expected a share of 0 to 1, got {share}")
        check_stop(self.stop)
        if not self.frames and self.range.mode != "off":
            raise ValueError(
                f"range.mode: expected off without preceding frames (L = 0), got {self.range.mode}"
            )
        if self.refresh.age and (not self.frames or self.reprojection != Reprojection()):
            raise ValueError(
                "refresh.age: expected 0 without preceding frames (L = 0) or where reprojection is "
                f"not nearest, exact and expected, got {self.refresh.age}"
            )

    def check(self, grid: HashGrid, renderer: Renderer2d) -> None:
        """Refuse, with a ValueError, what a field of `grid` or the `renderer` cannot do."""
        if self.levels is not None:
            grid.check_levels(self.levels)
        check_refined("pipeline.refined", self.refined, renderer)
        if self.jitter and not renderer.shifts:
            raise ValueError(
                f"pipeline.jitter: {type(renderer).__name__} takes every sample for the middle of "
                "its cell, expected false, got true"
            )

    def taught(self, refined: float) -> PipelineOptions:
        """The options of a training. It looks everywhere, so that one serves all choices of where
        to look that are made afterwards."""
        off = RangeReduction("off")
        return replace(
            self,
            range=off,
            refresh=Refresh(),
            overlap=0.0,
            refined=refined,
            refined_steps=1.0,
            skip=Skips(),
        )

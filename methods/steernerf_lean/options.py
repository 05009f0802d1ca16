"""Settings of the lean SteerNeRF: those of the paper's method, and its own."""

from __future__ import annotations

from dataclasses import dataclass, replace

from methods.kernels.types import expect
from methods.rendering.occupancy import STEP
from methods.rendering.sampling import Sampling, check_step
from methods.steernerf.options import EVERYWHERE, JointOptions, Model, Rendering, Skips


@dataclass(frozen=True)
class LeanRendering(Rendering):
    """Further settings that are chosen after training."""

    overlap: float  # a preceding frame of which the present view sees less than this is dropped
    refined: float  # share of the cells that the field renders: those with the largest error
    refined_step: float  # ray-marching step in these cells, in diagonals of the cube / 1024

    def __post_init__(self) -> None:
        super().__post_init__()
        check_step("refined_step", self.refined_step)
        expect(0 <= self.overlap <= 1, "overlap", "a share of 0 to 1", self.overlap)
        expect(0 <= self.refined <= 1, "refined", "a share of 0 to 1", self.refined)

    @property
    def refined_sampling(self) -> Sampling:
        """How rays of refined cells are marched."""
        return replace(self.sampling, step=self.refined_step * STEP)


@dataclass(frozen=True)
class LeanJointOptions(JointOptions):
    """Further settings of stage 2."""

    error_weight: float  # weight of the squared difference of estimated and true log error
    refined: float  # share of the cells that are refined during training
    refined_step: float  # ray-marching step in these cells, in diagonals of the cube / 1024
    refined_rays: int  # pixels of these cells that the field learns from in a step
    clip: float | None  # maximum norm of the 2D renderer's gradient; None: no clipping
    average: float  # decay of the running mean of the weights, which is the result; 0: no mean

    def __post_init__(self) -> None:
        super().__post_init__()
        check_step("joint.refined_step", self.refined_step)
        clip, average = self.clip, self.average
        expect(clip is None or clip > 0, "joint.clip", "more than 0, or null", clip)
        expect(self.error_weight >= 0, "joint.error_weight", "0 or more", self.error_weight)
        expect(self.refined_rays >= 1, "joint.refined_rays", "1 or more", self.refined_rays)
        expect(0 <= average < 1, "joint.average", "a share of less than 1", average)
        expect(0 <= self.refined <= 1, "joint.refined", "a share of 0 to 1", self.refined)

    def rendering(self, model: Model) -> LeanRendering:
        """How frames are rendered in training: everywhere, and refined as these options say."""
        skip = Skips(empty=True, hidden=True, background=True)
        own = {"overlap": 0.0, "refined": self.refined, "refined_step": self.refined_step}
        return LeanRendering(model.step, model.stop, EVERYWHERE, skip, **own)

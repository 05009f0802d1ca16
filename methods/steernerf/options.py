"""The settings of SteerNeRF: what is trained, how, and what is chosen afterwards."""

import math
from dataclasses import dataclass
from typing import Literal

from methods.kernels.composite import check_stop
from methods.kernels.types import expect
from methods.rendering.occupancy import STEP
from methods.rendering.sampling import Sampling, check_step


@dataclass(frozen=True)
class ModelOptions:
    """What a SteerNeRF is trained for: changing any of it requires training again."""

    channels: int  # K, number of features of the field; the first three are RGB
    frames: int  # L, number of preceding frames
    scale: int  # s; the field is rendered at 1/s of the resolution
    step: float  # ray-marching step at low resolution, in diagonals of the cube / 1024
    stop: float  # transmittance at which a ray ends
    feature_background: float  # what features beyond RGB are composited on

    def __post_init__(self) -> None:
        expect(3 <= self.channels <= 256, "channels", "3 to 256", self.channels)
        expect(0 <= self.frames <= 64, "frames", "0 to 64", self.frames)
        expect(1 <= self.scale <= 64, "scale", "1 to 64", self.scale)
        check_step("step", self.step)
        check_stop(self.stop)


@dataclass(frozen=True)
class RangeReduction:
    """Where along a ray to sample, by the depth D of the newest preceding frame (Section 3.2)."""

    mode: Literal["off", "paper"]  # off: everywhere; paper: near the D reprojected onto the pixel
    epsilon: float  # how near, in scene units along z
    depth: Literal["sum", "expected"]  # D: sum w t, as in the release, or that / the opacity

    def __post_init__(self) -> None:
        expect(self.epsilon > 0, "range.epsilon", "more than 0", self.epsilon)


EVERYWHERE = RangeReduction("off", epsilon=1.0, depth="sum")  # the last two say nothing


@dataclass(frozen=True)
class Skips:
    """Work to skip because no picture shows it; switch one off to measure what it saves."""

    empty: bool  # samples in empty cells, and rays that meet no other cells
    hidden: bool  # samples behind a transmittance of `Rendering.stop`
    background: bool  # pixels of the 2D renderer that are not near matter


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


@dataclass(frozen=True)
class MotionOptions:
    """The synthetic motions of L frames before a training view."""

    degrees: tuple[float, float]  # range of the angular speed, in degrees per frame
    pool: int  # examples kept at a time
    uses: int  # patches cut from an example before it is replaced

    def __post_init__(self) -> None:
        degrees = self.degrees
        ordered = len(degrees) == 2 and 0 <= degrees[0] <= degrees[1]
        expect(ordered, "joint.motion.degrees", "a range from 0 on", degrees)
        expect(self.pool >= 1, "joint.motion.pool", "1 or more", self.pool)
        expect(self.uses >= 1, "joint.motion.uses", "1 or more", self.uses)


@dataclass(frozen=True)
class JointOptions:
    """How stage 2 is trained; rates fall or wave along `methods.training.loop.cosine`."""

    field: Literal["joint", "frozen"]  # frozen: as stage 1 left it (the paper's Table 5)
    optimiser: Literal["muon", "adam"]  # of the 2D renderer; adam, as in the release
    rate: float  # initial learning rate of the 2D renderer
    field_rate: float  # initial learning rate of the field
    final_rate: float  # final learning rate of both
    half_waves: int  # half waves of their schedule, an odd number
    patch: int  # maximum side of a patch, in low-resolution pixels
    patch_share: float  # the same as a share of the shortest side of all low-resolution frames
    batch: int  # patches per step
    jitter: bool  # whether the samples of each ray have a random phase
    opacity_entropy: float  # weight of -o ln o of the rays' opacity o
    grid_samples: int  # cells visited per update of the density grid; 0: it stays as it was
    distilled_views: int  # maximum number of pictures of the stage 1 field to learn from as well
    distilled_share: float  # share of the patches that come from these pictures
    motion: MotionOptions  # the motion that precedes a training view

    def __post_init__(self) -> None:
        expect(self.rate > 0, "joint.rate", "more than 0", self.rate)
        expect(self.field_rate > 0, "joint.field_rate", "more than 0", self.field_rate)
        expect(self.final_rate > 0, "joint.final_rate", "more than 0", self.final_rate)
        waves, visits, entropy = self.half_waves, self.grid_samples, self.opacity_entropy
        expect(waves > 0 and waves % 2 == 1, "joint.half_waves", "an odd number", waves)
        expect(self.patch >= 1, "joint.patch", "1 or more", self.patch)
        expect(0 < self.patch_share <= 1, "joint.patch_share", "a share above 0", self.patch_share)
        expect(self.batch >= 1, "joint.batch", "1 or more", self.batch)
        expect(entropy >= 0, "joint.opacity_entropy", "0 or more", entropy)
        expect(visits == 0 or visits >= 2, "joint.grid_samples", "0, or 2 or more", visits)
        views, share = self.distilled_views, self.distilled_share
        expect(views >= 0, "joint.distilled_views", "0 or more", views)
        expect(0 <= share <= 1, "joint.distilled_share", "a share of 0 to 1", share)

    def rendering(self, model: ModelOptions) -> Rendering:
        """How frames are rendered in training: everywhere, which serves all later choices."""
        skip = Skips(empty=True, hidden=True, background=True)
        return Rendering(model.step, model.stop, EVERYWHERE, skip)

    def distilled(self, steps: int) -> int:
        """How many distilled views a training of `steps` steps can use."""
        examples = self.motion.pool + steps * self.batch / self.motion.uses
        return min(self.distilled_views, math.ceil(self.distilled_share * examples))

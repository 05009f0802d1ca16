"""The settings of SteerNeRF: what is trained, how, and what is chosen afterwards."""

import math
from dataclasses import dataclass
from typing import Annotated, Literal

from methods.kernels.march.contraction import HALF
from methods.kernels.settings import (
    Checked,
    Count,
    Length,
    NotNegative,
    Only,
    Positive,
    Share,
    Stop,
    between,
)
from methods.rendering.occupancy import STEP
from methods.rendering.sampling import Sampling


@dataclass(frozen=True)
class ModelOptions(Checked):
    """What a SteerNeRF is trained for: changing any of it requires training again."""

    channels: Annotated[int, between(3, 256)]  # K features of the field; the first three are RGB
    frames: Annotated[int, between(0, 64)]  # L, number of preceding frames
    scale: Annotated[int, between(1, 64)]  # s; the field is rendered at 1/s of the resolution
    step: Length  # of the march at low resolution, in diagonals of the box / 1024
    stop: Stop  # transmittance at which a ray ends
    feature_background: float  # what features beyond RGB are composited on


@dataclass(frozen=True)
class RangeReduction(Checked):
    """Where along a ray to sample, by the depth D of the newest preceding frame (Section 3.2)."""

    mode: Literal["off", "paper"]  # off: everywhere; paper: near the D reprojected onto the pixel
    epsilon: Positive  # how near, in scene units along z
    depth: Literal["sum", "expected"]  # D: sum w t, as in the release, or that / the opacity

    prefix = "range."


EVERYWHERE = RangeReduction("off", epsilon=1.0, depth="sum")  # the last two say nothing


@dataclass(frozen=True)
class Skips:
    """Work to skip because no picture shows it; switch one off to measure what it saves."""

    empty: bool  # samples in empty cells, and rays that meet no other cells
    hidden: bool  # samples behind a transmittance of `Rendering.stop`
    background: bool  # pixels of the 2D renderer that are not near matter


@dataclass(frozen=True)
class Rendering(Checked):
    """Settings chosen after training: one training serves every choice."""

    step: Length  # of the march at low resolution, in diagonals of the box / 1024
    stop: Stop  # transmittance at which a ray ends
    range: RangeReduction
    skip: Skips

    def sampling(self, contracted: bool) -> Sampling:
        """How rays at low resolution are marched. The box has half the sides of a `contracted`
        cube: its steps are as fine as those of a box that is the cube."""
        step = self.step * STEP * (2 * HALF if contracted else 1)
        return Sampling(step=step, stop=self.stop if self.skip.hidden else 0.0)


@dataclass(frozen=True)
class MotionOptions(Checked):
    """The synthetic motions of L frames before a training view."""

    # Range of the angular speed, in degrees per frame.
    degrees: Annotated[
        tuple[float, float], Only("a range from 0 on", lambda x: len(x) == 2 and 0 <= x[0] <= x[1])
    ]
    pool: Count  # examples kept at a time
    uses: Count  # patches cut from an example before it is replaced

    prefix = "joint.motion."


@dataclass(frozen=True)
class JointOptions(Checked):
    """How stage 2 is trained; rates fall or wave along `methods.training.loop.cosine`."""

    field: Literal["joint", "frozen"]  # frozen: as stage 1 left it (the paper's Table 5)
    optimiser: Literal["muon", "adam"]  # of the 2D renderer; adam, as in the release
    rate: Positive  # initial learning rate of the 2D renderer
    field_rate: Positive  # initial learning rate of the field
    final_rate: Positive  # final learning rate of both
    # Half waves of their schedule.
    half_waves: Annotated[int, Only("an odd number", lambda x: x > 0 and x % 2 == 1)]
    patch: Count  # maximum side of a patch, in low-resolution pixels
    batch: Count  # patches per step
    jitter: bool  # whether the samples of each ray have a random phase
    opacity_entropy: NotNegative  # weight of -o ln o of the rays' opacity o
    # Cells visited per update of the density grid; 0: it stays as it was.
    grid_samples: Annotated[int, Only("0, or 2 or more", lambda x: x == 0 or x >= 2)]
    # Maximum number of pictures of the stage 1 field to learn from as well.
    distilled_views: Annotated[int, Only("0 or more", lambda x: x >= 0)]
    distilled_share: Share  # share of the patches that come from these pictures
    motion: MotionOptions  # the motion that precedes a training view

    prefix = "joint."

    def rendering(self, model: ModelOptions) -> Rendering:
        """How frames are rendered in training: everywhere, which serves all later choices."""
        skip = Skips(empty=True, hidden=True, background=True)
        return Rendering(model.step, model.stop, EVERYWHERE, skip)

    def distilled(self, steps: int) -> int:
        """How many distilled views a training of `steps` steps can use."""
        examples = self.motion.pool + steps * self.batch / self.motion.uses
        return min(self.distilled_views, math.ceil(self.distilled_share * examples))

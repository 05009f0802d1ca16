"""How stage 2 is trained."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from methods.rendering.sampling import check_step
from methods.steernerf.training.sequences import MotionOptions


@dataclass(frozen=True)
class JointOptions:
    """How stage 2 is trained.

    Attributes:
        field: "joint", or "frozen" as stage 1 left it (the ablation of the paper's Table 5).
        through: frames that the field learns from: "all", or only the "present" one.
        features: how the features beyond RGB start: "random", with random weights, or "constant",
            1/2 everywhere.
        rate: initial learning rate of the 2D renderer.
        field_rate: initial learning rate of the field.
        final_rate: learning rate of both at the end of the cosine schedule.
        half_waves: half waves of that schedule, an odd number; see
            `methods.training.optimiser.cosine`.
        patch: maximum side of a patch, in low-resolution pixels.
        patch_share: maximum side of a patch, as a share of the shorter side of the low-resolution
            frame.
        place: where a patch lies: "anywhere", or around "content", a pixel that is not background.
        batch: patches per step.
        jitter: whether the samples of each ray have a random phase.
        opacity_entropy: weight of -o ln o of the rays' opacity o.
        error_weight: weight of the squared difference between the estimated log error and the
            true one.
        refined: share of the cells that are refined during training.
        refined_step: ray-marching step in these cells, in diagonals of the cube / 1024.
        refined_rays: pixels of these cells that the field learns from in a step.
        clip: maximum norm of the 2D renderer's gradient; None: no clipping.
        average: decay of the running mean of the 2D renderer's weights, which is the result; 0: the
            weights themselves.
        grid_samples: cells visited in an update of the density grid while the field learns; 0: it
            stays as stage 1 left it.
        distilled_views: maximum number of pictures of the stage 1 field, at random views, that are
            also learned from.
        distilled_share: share of the patches that come from these pictures.
        motion: the motion that precedes a training view.
    """

    field: Literal["joint", "frozen"] = "joint"
    through: Literal["all", "present"] = "present"
    features: Literal["random", "constant"] = "constant"
    rate: float = 1e-3
    field_rate: float = 1e-3
    final_rate: float = 1e-5
    half_waves: int = 1
    patch: int = 32
    patch_share: float = 1.0
    place: Literal["anywhere", "content"] = "content"
    batch: int = 2
    jitter: bool = False
    opacity_entropy: float = 1e-3
    error_weight: float = 1e-4
    refined: float = 0.2
    refined_step: float = 2.0
    refined_rays: int = 2048
    clip: float | None = 1.0
    average: float = 0.999
    grid_samples: int = 0
    distilled_views: int = 100
    distilled_share: float = 0.5
    motion: MotionOptions = MotionOptions()

    def __post_init__(self) -> None:
        check_step("joint.refined_step", self.refined_step)
        for wanted, fits, names in (
            ("more than 0", lambda x: x > 0, ("rate", "field_rate", "final_rate")),
            ("more than 0, or null", lambda x: x is None or x > 0, ("clip",)),
            ("0 or more", lambda x: x >= 0, ("opacity_entropy", "error_weight", "distilled_views")),
            ("1 or more", lambda x: x >= 1, ("patch", "batch", "refined_rays")),
            ("an odd number", lambda x: x > 0 and x % 2 == 1, ("half_waves",)),
            ("0, or 2 or more", lambda x: x == 0 or x >= 2, ("grid_samples",)),
            ("a share, more than 0", lambda x: 0 < x <= 1, ("patch_share",)),
            ("a share of less than 1", lambda x: 0 <= x < 1, ("average",)),
            ("a share of 0 to 1", lambda x: 0 <= x <= 1, ("refined", "distilled_share")),
        ):
            for name in names:
                if not fits(got := getattr(self, name)):
                    raise ValueError(f"joint.{name}: expected {wanted}, got {got}")

    def distilled(self, steps: int, frames: int) -> int:
        """How many distilled views a training of `steps` steps can use.

        With no preceding `frames` (L = 0), sequences are never continued.
        """
        longer = self.motion.longer if frames else 0.0
        sequences = self.motion.pool + (1 - longer) * steps * self.batch / self.motion.uses
        return min(self.distilled_views, math.ceil(self.distilled_share * sequences))

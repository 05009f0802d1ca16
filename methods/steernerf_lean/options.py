"""Settings of the lean SteerNeRF: those of the paper's method, and its own."""

from __future__ import annotations

from dataclasses import dataclass, replace

from methods.rendering.occupancy import STEP
from methods.rendering.sampling import Sampling, check_step
from methods.steernerf.options import Model, Rendering, Skips, check_size
from methods.steernerf.training.options import JointOptions, check_options


@dataclass(frozen=True)
class LeanModel(Model):
    """A model whose 2D renderer reads the preceding picture, if L = 1; L = 0: it does not."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_size("frames", self.frames, 0, 1)


@dataclass(frozen=True)
class LeanSkips(Skips):
    """Further work to skip."""

    background: bool  # cells that are not near matter


@dataclass(frozen=True)
class LeanRendering(Rendering):
    """Further settings that are chosen after training."""

    skip: LeanSkips
    overlap: (
        float  # least share of the preceding frame that the present view sees, or it is dropped
    )
    refined: float  # share of the cells that the field renders: those with the largest error
    refined_step: float  # ray-marching step in these cells, in diagonals of the cube / 1024

    def __post_init__(self) -> None:
        super().__post_init__()
        check_step("refined_step", self.refined_step)
        for name in ("overlap", "refined"):
            if not 0 <= (share := getattr(self, name)) <= 1:
                raise ValueError(f"{name}: expected a share of 0 to 1, got {share}")

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
        check_options(
            "joint",
            self,
            ("more than 0, or null", lambda x: x is None or x > 0, ("clip",)),
            ("0 or more", lambda x: x >= 0, ("error_weight",)),
            ("1 or more", lambda x: x >= 1, ("refined_rays",)),
            ("a share of less than 1", lambda x: 0 <= x < 1, ("average",)),
            ("a share of 0 to 1", lambda x: 0 <= x <= 1, ("refined",)),
        )

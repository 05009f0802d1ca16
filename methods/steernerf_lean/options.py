"""Settings of the lean SteerNeRF: those of the paper's method, and its own."""

from __future__ import annotations

from dataclasses import dataclass, replace

from methods.rendering.march import March, check_step
from methods.rendering.occupancy import STEP
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
    """Further work to skip.

    Attributes:
        background: cells that are not near matter.
    """

    background: bool


@dataclass(frozen=True)
class LeanRendering(Rendering):
    """Further settings that are chosen after training.

    Attributes:
        overlap: the preceding frame is dropped if the present view sees less than this share of
            what it shows; see `history.overlap`.
        refined: share of the cells whose pixels the field renders instead: those with the largest
            estimated error.
        refined_step: ray-marching step in these cells, in diagonals of the cube / 1024.
    """

    skip: LeanSkips
    overlap: float
    refined: float
    refined_step: float

    def __post_init__(self) -> None:
        super().__post_init__()
        check_step("refined_step", self.refined_step)
        for name in ("overlap", "refined"):
            if not 0 <= (share := getattr(self, name)) <= 1:
                raise ValueError(f"{name}: expected a share of 0 to 1, got {share}")

    @property
    def refined_march(self) -> March:
        """How rays of refined cells are marched."""
        return replace(self.march, step=self.refined_step * STEP)


@dataclass(frozen=True)
class LeanJointOptions(JointOptions):
    """Further settings of stage 2.

    Attributes:
        error_weight: weight of the squared difference between the estimated log error and the
            true one.
        refined: share of the cells that are refined during training.
        refined_step: ray-marching step in these cells, in diagonals of the cube / 1024.
        refined_rays: pixels of these cells that the field learns from in a step.
        clip: maximum norm of the 2D renderer's gradient; None: no clipping.
        average: decay of the running mean of the 2D renderer's weights, which is the result; 0: the
            weights themselves.
    """

    error_weight: float
    refined: float
    refined_step: float
    refined_rays: int
    clip: float | None
    average: float

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

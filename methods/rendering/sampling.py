"""How rays are marched: their steps, and where they end."""

from dataclasses import dataclass, replace
from typing import Self

from torch import Tensor

from methods.kernels.composite import STOP
from methods.rendering.occupancy import RESOLUTION, STEP

FAINT = 0.1
"""A sample whose weight is below `FAINT * stop` has an opacity but no features: the error is less
than a tenth of what the early stop may cause."""


def suitable_step(steps: int) -> float:
    """World length of the ray-marching step that suits a training of `steps` steps.

    With the same number of samples, longer steps allow more rays. This pays until the detail of the
    field is finer than the step. The length is 2.7 diagonals of the cube / 1024 for 1,000 training
    steps and falls with their cube root: at 20,000, as many as the release trains, it is 1, as in
    the release. It never exceeds a cell of the density grid, which a longer step would miss.
    Measured up to 3,000 steps of 32,768 samples: docs/log.md, "The step that a training needs".
    """
    return min(STEP * (20_000 / steps) ** (1 / 3), 1 / RESOLUTION)


@dataclass(frozen=True)
class Sampling:
    """How rays are marched."""

    step: float = STEP  # world length
    stop: float = STOP  # transmittance at which a ray ends
    window: Tensor | None = None  # in frames: [R, 2] nearest and farthest t; None: all of a ray
    # In training: of the samples with an optical depth sigma delta below this, which hardly show,
    # one of some is kept and gets the length of all. Which one is left to chance: the expected
    # optical depth and its gradient stay the same.
    thin: float = 0.0

    def of(self, index: Tensor | slice) -> Self:
        """The same for some of the rays."""
        return self if self.window is None else replace(self, window=self.window[index])

    @property
    def least_weight(self) -> float:
        """Weight of a sample below which its features are not evaluated."""
        return FAINT * self.stop

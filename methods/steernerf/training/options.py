"""How stage 2 is trained."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal


@dataclass(frozen=True)
class MotionOptions:
    """The synthetic motions before a training view."""

    degrees: tuple[float, float]  # range of the angular speed, in degrees per frame
    length: int  # maximum number of frames that precede a view
    least: int  # minimum number; fewer than L, and sometimes none, teach the cold start
    pool: int  # examples kept at a time
    uses: int  # patches cut from an example before it is replaced
    longer: float  # probability that it is continued instead, there and back to its view

    def __post_init__(self) -> None:
        low, high = self.degrees
        if not (0 <= low <= high and 0 <= self.least <= self.length):
            raise ValueError(
                f"expected 0 <= degrees[0] <= degrees[1] and 0 <= least <= length: {self}"
            )
        check_options(
            "joint.motion",
            self,
            ("1 or more", lambda x: x >= 1, ("pool", "uses")),
            ("a share of less than 1", lambda x: 0 <= x < 1, ("longer",)),
        )


@dataclass(frozen=True)
class JointOptions:
    """How stage 2 is trained; rates fall or wave along `methods.training.loop.cosine`."""

    field: Literal["joint", "frozen"]  # frozen: as stage 1 left it (the paper's Table 5)
    features: Literal["random", "constant"]  # initial features beyond RGB; constant: 1/2
    rate: float  # initial learning rate of the 2D renderer
    field_rate: float  # initial learning rate of the field
    final_rate: float  # final learning rate of both
    half_waves: int  # half waves of their schedule, an odd number
    patch: int  # maximum side of a patch, in low-resolution pixels
    patch_share: float  # the same as a share of the shorter side of the low-resolution frame
    batch: int  # patches per step
    jitter: bool  # whether the samples of each ray have a random phase
    opacity_entropy: float  # weight of -o ln o of the rays' opacity o
    grid_samples: int  # cells visited per update of the density grid; 0: it stays as it was
    distilled_views: int  # maximum number of pictures of the stage 1 field to learn from as well
    distilled_share: float  # share of the patches that come from these pictures
    motion: MotionOptions  # the motion that precedes a training view

    def __post_init__(self) -> None:
        check_options(
            "joint",
            self,
            ("more than 0", lambda x: x > 0, ("rate", "field_rate", "final_rate")),
            ("0 or more", lambda x: x >= 0, ("opacity_entropy", "distilled_views")),
            ("1 or more", lambda x: x >= 1, ("patch", "batch")),
            ("an odd number", lambda x: x > 0 and x % 2 == 1, ("half_waves",)),
            ("0, or 2 or more", lambda x: x == 0 or x >= 2, ("grid_samples",)),
            ("a share, more than 0", lambda x: 0 < x <= 1, ("patch_share",)),
            ("a share of 0 to 1", lambda x: 0 <= x <= 1, ("distilled_share",)),
        )

    def distilled(self, steps: int, frames: int) -> int:
        """How many distilled views a training of `steps` steps can use. With no preceding `frames`
        (L = 0), examples are never continued."""
        longer = self.motion.longer if frames else 0.0
        examples = self.motion.pool + (1 - longer) * steps * self.batch / self.motion.uses
        return min(self.distilled_views, math.ceil(self.distilled_share * examples))


Rule = tuple[str, Callable[[Any], bool], tuple[str, ...]]
"""What is expected, whether a value is that, and the names of the options it is expected of."""


def check_options(where: str, options: object, *rules: Rule) -> None:
    """Raise ValueError unless the `options`, which are settings below `where`, keep all `rules`."""
    for wanted, fits, names in rules:
        for name in names:
            if not fits(got := getattr(options, name)):
                raise ValueError(f"{where}.{name}: expected {wanted}, got {got}")

"""How far rays are marched, and in which steps."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from bench.types import Scene
from methods.kernels.composite import STOP
from methods.rendering.occupancy import RESOLUTION, STEP

FAINT = 0.1
"""A sample of less weight than `FAINT * stop` has an opacity but no features: the error is less
than a tenth of what the early stop may cause."""


def suitable_step(scene: Scene) -> float:
    """World length of a step that suits the training pictures of `scene`: the geometric mean of the
    width of a pixel where the scene is and that of a cell of the density grid.

    Shorter steps tell apart what no picture shows; longer ones miss what the grid has found. With
    as many samples, longer steps are more rays, too, so that a training sees more pixels.
    docs/log.md has the measurements that this follows, "The step that a scene needs".
    """
    cameras = scene.splits["train"].cameras
    corners = torch.cartesian_prod(*scene.bounds.cpu().unbind(dim=1))  # of what may be seen, [8, 3]
    places = torch.stack([camera.c2w[:, 3].cpu() for camera in cameras])
    distance = torch.cdist(places, corners).mean(dim=1)
    focal = torch.tensor([math.sqrt(camera.fx * camera.fy) for camera in cameras])
    footprint = (distance / focal).median().item()
    cell = 1 / RESOLUTION
    return math.sqrt(min(footprint, cell) * cell)


def check_step(name: str, length: float) -> None:
    """Refuse, with a ValueError, a step that leads nowhere."""
    if not length > 0:
        raise ValueError(f"{name}: expected a length of more than 0, got {length}")


@dataclass(frozen=True)
class March:
    """How rays are marched.

    Attributes:
        step: world length of a step.
        stop: transmittance at which a ray ends.
        window: [R, 2] nearest and farthest t of each ray; None: all of it.
        faint: weight below which a sample has an opacity but no features; None: `FAINT * stop`.
    """

    step: float = STEP
    stop: float = STOP
    window: Tensor | None = None
    faint: float | None = None

    @property
    def least_weight(self) -> float:
        """Weight of a sample below which its features are not evaluated."""
        return FAINT * self.stop if self.faint is None else self.faint

    def within(self, window: Tensor | None) -> March:
        """The same within `window` [R, 2]."""
        return replace(self, window=window)

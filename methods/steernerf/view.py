"""What the pipeline makes of a camera: its low-resolution grid, and where the samples lie on it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import torch
from torch import Tensor

from bench.cameras import scale_camera
from bench.types import Camera


@dataclass(frozen=True)
class View:
    """A camera as the pipeline sees it.

    Attributes:
        full: the camera, its picture enlarged to the right and below to multiples of s.
        low: its low-resolution camera, whose pixel centres lie `phase` beside those of s x s
            pixels.
        phase: (u, v) in full-resolution pixels.
    """

    full: Camera
    low: Camera
    phase: tuple[float, float]

    @classmethod
    def of(cls, camera: Camera, scale: int, turn: int = 0, *, jitter: bool = False) -> View:
        """The view of the `turn`-th frame of a sequence; `scale` and `jitter` are options of the
        pipeline."""
        width, height = -(-camera.width // scale), -(-camera.height // scale)
        full = replace(camera, width=width * scale, height=height * scale)
        low = scale_camera(full, width, height)
        phase = sample_phase(turn, scale) if jitter else (0.0, 0.0)
        low = replace(low, cx=low.cx - phase[0] / scale, cy=low.cy - phase[1] / scale)
        return cls(full, low, phase)


def sample_phase(turn: int, scale: int) -> tuple[float, float]:
    """Where the low-resolution samples of the `turn`-th frame lie beside the middle of their cell.

    On the centre of one of its s x s pixels; s^2 frames visit all of them where s is a power of 2,
    and any few that follow each other lie apart.
    """
    u, v = (_phases(scale)[turn % scale**2] * scale).floor().tolist()
    return u - (scale - 1) / 2, v - (scale - 1) / 2


@cache
def _phases(scale: int) -> Tensor:
    return torch.quasirandom.SobolEngine(2).draw(scale**2)

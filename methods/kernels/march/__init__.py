"""Ray marching through an occupancy grid: samples only in cells that may hold matter.

A ray enters the unit cube at t_0 and is divided into steps of equal world length:
t_k = t_0 + (k + phase) step / norm(d), with phase 1/2 (midpoint rule) or a jitter in [0, 1).
Sample k exists if the cell at o + t_k d is occupied and t_k is in the ray's window. The set of
samples does not depend on how empty space is skipped, so that all backends return the same samples;
a window removes samples but moves none.

Where the grid is of contracted space, rays start at the camera, the steps are those of
`contraction`, and the cell is that of the contracted position.
"""

import math
from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor

from bench.types import Rays, ThreeTensors, check_shape
from methods.kernels.dispatch import implementation
from methods.kernels.types import Occupancy, Samples, check_rays, expect

MAX_SAMPLES = 1024  # most samples of a ray through the unit cube at the usual step, sqrt(3) / 1024

LEAST_STEP = 2.0**-126
"""A ray whose step in t is smaller has no samples: float32 holds such numbers with few digits, and
their reciprocals overflow."""


@dataclass(frozen=True)
class Segments:
    """The parts of R rays to sample, with all that `march` may be given."""

    rays: Rays
    step: float
    window: Tensor
    jitter: Tensor
    start: Tensor
    limit: int


def march(
    rays: Rays,
    occupancy: Occupancy,
    step: float,
    *,
    window: Tensor | None = None,
    jitter: Tensor | None = None,
    start: Tensor | None = None,
    limit: int | None = None,
    backend: str = "auto",
) -> Samples:
    """Sample R `rays` inside the unit cube, or in all of space if it is contracted into the cube.
    Not differentiable. The host waits for a GPU, once.

    A ray has no samples if it misses the cube, is not finite, or has a direction that is zero, so
    short that t overflows, or so long that a step in t is below `LEAST_STEP`.

    Args:
        step: world length of a step, scene units.
        window: [R, 2] nearest and farthest t, the latter excluded; None: [0, inf).
        jitter: [R] phase of a ray's samples in [0, 1); None: 1/2.
        start: [R] int32 first step, from `Samples.resume` of an earlier call with the same rays;
            negative: no samples; None: 0.
        limit: maximum number of samples per ray; None: all.
    """
    count = check_rays(rays)
    every, middle, first = _usual(rays.origins.device, rays.origins.dtype)
    window = every.expand(count, 2) if window is None else window
    jitter = middle.expand(count) if jitter is None else jitter
    start = first.expand(count) if start is None else start
    check_shape("window", window, count, 2)
    check_shape("jitter", jitter, count)
    check_shape("start", start, count)
    expect(step > 0, "step", "a positive length", step)
    limit = longest_ray(step) if limit is None else limit
    expect(limit >= 1, "limit", "1 or more", limit)
    segments = Segments(rays, step, window, jitter, start, limit)
    return implementation(__name__, backend, rays.origins.device).march(segments, occupancy)


def longest_ray(step: float) -> int:
    """Upper bound on the samples of a ray: those on the cube's diagonal, plus some for rounding."""
    return math.ceil(math.sqrt(3) / step) + 1


@cache
def _usual(device: torch.device, dtype: torch.dtype) -> ThreeTensors:
    """Window, phase and first step of a ray for which none is given."""
    window, jitter = (torch.tensor(x, dtype=dtype, device=device) for x in ([0, math.inf], [0.5]))
    return window, jitter, torch.zeros(1, dtype=torch.int32, device=device)

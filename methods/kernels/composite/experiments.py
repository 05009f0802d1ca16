"""Experiments on the quadrature of volume rendering: march and compositing in analytic media.

Rays run along x through the unit cube, starting at its face x = 0; the density of the medium on a
ray depends on y. With the optical thickness tau(x) = int_0^x sigma, opacity and depth are

alpha = 1 - exp(-tau(1)),  depth_sum = int_0^1 x sigma exp(-tau) = int_0^1 exp(-tau) - exp(-tau(1)).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from bench.accuracy import Experiment, Trial
from bench.types import Rays
from methods.kernels.composite import composite
from methods.kernels.march import march
from methods.kernels.types import Intervals, Occupancy

Quantity = Literal["alpha", "depth_sum"]

RAYS = 256
NODES = 256
"""Nodes of the Gauss-Legendre rule for the depth; enough that only rounding errors remain."""

STEPS = [2.0**-power for power in range(2, 11)]
"""Step lengths of the march, in cube sides; the smallest gives the maximum number of samples."""

WIDTH = 0.1
"""Standard deviation of the Gaussian density."""

THIN = 1 / 32
"""Optical thickness of a sample in the experiment on early stopping."""


@dataclass(frozen=True)
class Medium:
    """A density in the unit cube, and the optical thickness in front of a point on rays along x.

    Attributes:
        sigma: function of x and y [N]: density [N].
        thickness: function of x and y [N]: optical thickness [N] from 0 to x.
    """

    name: str
    sigma: Callable[[Tensor, Tensor], Tensor]
    thickness: Callable[[Tensor, Tensor], Tensor]

    def exact(self, quantity: Quantity, y: Tensor) -> Tensor:
        """Exact quantity [R] of the rays at `y` [R] float64; depth needs a smooth `thickness`."""
        behind = torch.exp(-self.thickness(torch.ones_like(y), y))
        if quantity == "alpha":
            return 1 - behind
        x, weight = (torch.from_numpy(part) for part in np.polynomial.legendre.leggauss(NODES))
        x, at = torch.meshgrid((x + 1) / 2, y, indexing="ij")
        return weight / 2 @ torch.exp(-self.thickness(x, at)) - behind


def _strength(y: Tensor) -> Tensor:
    """Density on the ray at y: the cube's opacity goes from two thirds at one end to almost 1."""
    return 1 + 7 * y


def _peak(x: Tensor, y: Tensor) -> Tensor:
    return 4 * _strength(y) * torch.exp(-(((x - 0.5) / WIDTH) ** 2) / 2)


def _up_to(x: Tensor, y: Tensor) -> Tensor:
    """The integral of `_peak` from 0 to x."""
    root = math.sqrt(2) * WIDTH
    area = torch.erf((x - 0.5) / root) + math.erf(0.5 / root)
    return 4 * _strength(y) * WIDTH * math.sqrt(math.pi / 2) * area


def _first_face(y: Tensor) -> Tensor:
    """x at which the slab begins: between samples, at a different place on every ray."""
    return 0.3 + 0.1 * y


GAUSSIAN = Medium("Gaussian density", _peak, _up_to)
SLAB = Medium(
    "homogeneous slab",
    lambda x, y: _strength(y) * ((x > _first_face(y)) & (x < 0.7)),
    lambda x, y: _strength(y) * (x.clamp(max=0.7) - _first_face(y)).clamp(min=0),
)

FINE = (2.0**-7, 2.0**-4)
"""Range of steps that resolve a Gaussian and leave errors far above rounding."""


def experiments() -> list[Experiment]:
    """Experiments on step length, sample position, early stop, and the precision of the sums."""
    return [
        # The midpoint rule is exact here but for rounding: its error follows no power.
        _steps(GAUSSIAN, "alpha", None),
        _steps(GAUSSIAN, "depth_sum", FINE),
        _steps(GAUSSIAN, "depth_sum", FINE, phase=0.0),
        _steps(SLAB, "alpha", (STEPS[-1], STEPS[0])),
        _stops(),
        *(_accumulation(*kind) for kind in ACCUMULATORS),
    ]


def _steps(
    medium: Medium, quantity: Quantity, smooth: tuple[float, float] | None, phase: float = 0.5
) -> Experiment:
    y = _ray_heights()
    exact = medium.exact(quantity, y.double())
    subject = f"{medium.name}: {'opacity' if quantity == 'alpha' else 'depth'}"
    if phase != 0.5:
        subject += ", samples where their intervals begin"
    trials = [
        Trial(step, partial(render, medium, quantity, y, step, phase), exact) for step in STEPS
    ]
    return Experiment(subject, "step, sides of the cube", trials, smooth)


def _ray_heights() -> Tensor:
    return (torch.arange(RAYS) + 0.5) / RAYS


def render(medium: Medium, quantity: Quantity, y: Tensor, step: float, phase: float) -> Tensor:
    """Opacity or depth [R] of the rays at `y` [R], by march and compositing, without early stop."""
    origins = torch.stack((torch.zeros_like(y), y, torch.full_like(y, 0.5)), dim=1)
    rays = Rays(origins, torch.eye(3)[:1].expand(len(y), 3))
    occupancy = Occupancy(torch.ones(16, 16, 16))
    jitter = torch.full_like(y, phase)
    samples = march(rays, occupancy, step, jitter=jitter)
    sigma = medium.sigma(samples.positions[:, 0], samples.positions[:, 1])
    values = torch.zeros(len(samples), 1)
    pixels = composite(sigma, values, samples, stop=0.0)
    return getattr(pixels, quantity)


def _stops() -> Experiment:
    """Rays with samples of thickness `THIN` that end at a given transmittance."""
    inputs, exact = _even_rays(RAYS, 1024, 1024 * THIN)
    stops = [0.0, *(10.0**-power for power in range(7, 0, -1))]
    trials = [Trial(stop, partial(_opacity, *inputs, stop), exact) for stop in stops]
    return Experiment("early stop: light that leaks", "stop", trials, (1e-5, 1e-1))


ACCUMULATORS: tuple[tuple[str, torch.dtype], ...] = (
    ("cpu", torch.float32),
    ("reference", torch.float32),
    ("reference", torch.float64),
)


def _accumulation(backend: str, dtype: torch.dtype) -> Experiment:
    """Opacity of rays divided into more and more samples; 2^18 samples over all rays.

    All samples are equal, so that all are rounded the same way.
    """
    trials = []
    for count in (64, 1024, 65536):
        (sigma, delta, offsets), exact = _even_rays((1 << 18) // count, count, 4.0)
        inputs = sigma.to(dtype), delta.to(dtype), offsets
        trials.append(Trial(count, partial(_opacity, *inputs, 0.0, backend), exact))
    kind = str(dtype).removeprefix("torch.")
    return Experiment(f"opacity added up: {backend} in {kind}", "samples of a ray", trials)


def _even_rays(
    rays: int, count: int, thickness: float
) -> tuple[tuple[Tensor, Tensor, Tensor], Tensor]:
    """Density, interval and offsets of `rays` with `count` equal samples each; the exact opacity.

    `count` is a power of 2.
    """
    delta = torch.full((rays * count,), 1 / count)
    offsets = torch.arange(rays + 1) * count
    exact = torch.full((rays,), -math.expm1(-thickness), dtype=torch.float64)
    return (torch.full_like(delta, thickness), delta, offsets), exact


def _opacity(
    sigma: Tensor, delta: Tensor, offsets: Tensor, stop: float, backend: str = "auto"
) -> Tensor:
    nothing = torch.zeros(len(sigma), 1, dtype=sigma.dtype)
    intervals = Intervals(delta, delta, offsets)
    return composite(sigma, nothing, intervals, stop=stop, backend=backend).alpha

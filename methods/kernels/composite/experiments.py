"""Experiments on the quadrature of volume rendering: step, sample position, early stop.

Rays run along x through the unit cube, from its face x = 0; the density on a ray is a Gaussian
whose height depends on y. With the optical thickness tau(x) = int_0^x sigma, opacity and depth are

alpha = 1 - exp(-tau(1)),  depth_sum = int_0^1 x sigma exp(-tau) = int_0^1 exp(-tau) - exp(-tau(1)).
"""

from __future__ import annotations

import math
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

FINE = (2.0**-7, 2.0**-4)
"""Range of steps that resolve the Gaussian and leave errors far above rounding."""

CENTRE, WIDTH = 0.5, 0.1
"""Mean and standard deviation of the Gaussian."""

THIN = 1 / 32
"""Optical thickness of a sample in the experiment on early stopping."""


def density(x: Tensor, y: Tensor) -> Tensor:
    """Density [N]: at one end of y the cube's opacity is two thirds, at the other almost 1."""
    return (4 + 28 * y) * torch.exp(-(((x - CENTRE) / WIDTH) ** 2) / 2)


def thickness(x: Tensor, y: Tensor) -> Tensor:
    """Optical thickness [N] from 0 to x."""
    root = math.sqrt(2) * WIDTH
    area = torch.erf((x - CENTRE) / root) + math.erf(CENTRE / root)
    return (4 + 28 * y) * WIDTH * math.sqrt(math.pi / 2) * area


def exact(quantity: Quantity, y: Tensor) -> Tensor:
    """Exact opacity or depth [R] of the rays at `y` [R] float64."""
    behind = torch.exp(-thickness(torch.ones_like(y), y))
    if quantity == "alpha":
        return 1 - behind
    x, weight = (torch.from_numpy(part) for part in np.polynomial.legendre.leggauss(NODES))
    x, at = torch.meshgrid((x + 1) / 2, y, indexing="ij")
    return weight / 2 @ torch.exp(-thickness(x, at)) - behind


def experiments() -> list[Experiment]:
    """The opacity's error follows no power of the step: it is rounding where the step is fine."""
    return [
        _steps("opacity", "alpha", None),
        _steps("depth", "depth_sum", FINE),
        _steps("depth, samples where their intervals begin", "depth_sum", FINE, phase=0.0),
        _stops(),
    ]


def _steps(
    name: str, quantity: Quantity, smooth: tuple[float, float] | None, phase: float = 0.5
) -> Experiment:
    y = (torch.arange(RAYS) + 0.5) / RAYS
    truth = exact(quantity, y.double())
    trials = [Trial(step, partial(_rendered, quantity, y, step, phase), truth) for step in STEPS]
    return Experiment(f"Gaussian density: {name}", "step, sides of the cube", trials, smooth)


def _rendered(quantity: Quantity, y: Tensor, step: float, phase: float) -> Tensor:
    """Opacity or depth [R] of the rays at `y` [R], by march and compositing, without early stop."""
    origins = torch.stack((torch.zeros_like(y), y, torch.full_like(y, 0.5)), dim=1)
    rays = Rays(origins, torch.eye(3)[:1].expand(len(y), 3))
    everywhere = Occupancy(torch.ones(16, 16, 16))
    samples = march(rays, everywhere, step, jitter=torch.full_like(y, phase))
    sigma = density(samples.positions[:, 0], samples.positions[:, 1])
    pixels = composite(sigma, torch.zeros(len(samples), 1), samples, stop=0.0)
    return getattr(pixels, quantity)


def _stops() -> Experiment:
    """Rays with 1024 samples of thickness `THIN` that end at a given transmittance."""
    delta = torch.full((RAYS * 1024,), 1 / 1024)
    samples = Intervals(delta, delta, torch.arange(RAYS + 1) * 1024)
    sigma, nothing = torch.full_like(delta, 1024 * THIN), torch.zeros(len(delta), 1)
    truth = torch.full((RAYS,), -math.expm1(-1024 * THIN), dtype=torch.float64)

    def opacity(stop: float) -> Tensor:
        return composite(sigma, nothing, samples, stop=stop).alpha

    stops = (0.0, *(10.0**-power for power in range(7, 0, -1)))
    trials = [Trial(stop, partial(opacity, stop), truth) for stop in stops]
    return Experiment("early stop: light that leaks", "stop", trials, (1e-5, 1e-1))

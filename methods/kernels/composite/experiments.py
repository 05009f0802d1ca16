"""Experiments on the quadrature of volume rendering: step, sample position, early stop.

Rays run along x through the unit cube, from its face x = 0; the density on a ray is a ramp s x,
whose slope s depends on y. With the optical thickness tau = s x^2 / 2, opacity and depth are

alpha = 1 - exp(-s / 2),  depth_sum = int_0^1 x sigma exp(-tau) = int_0^1 exp(-tau) - exp(-s / 2).
"""

import math
from functools import partial

import torch
from torch import Tensor

from bench.convergence import Experiment, Trial
from bench.types import Rays
from methods.kernels.composite import composite
from methods.kernels.march import march
from methods.kernels.types import Intervals, Occupancy

RAYS = 256

STEPS = [2.0**-power for power in range(2, 11)]
"""Step lengths of the march, in cube sides; the smallest gives the maximum number of samples."""

FINE = (2.0**-7, 2.0**-4)
"""Range of steps that resolve the ramp and leave errors far above rounding."""

THIN = 1 / 32  # optical thickness of a sample in the experiment on early stopping


def slope(y: Tensor) -> Tensor:
    """Slope of the ramp; the cube's opacity is two thirds at y = 0 and almost 1 at y = 1."""
    return 2 + 14 * y


def exact(quantity: str, y: Tensor) -> Tensor:
    """Exact opacity, "alpha", or "depth_sum" [R] of the rays at `y` [R] float64."""
    s = slope(y)
    behind = torch.exp(-s / 2)
    if quantity == "alpha":
        return 1 - behind
    return torch.sqrt(math.pi / 2 / s) * torch.erf(torch.sqrt(s / 2)) - behind


def experiments() -> list[Experiment]:
    """The opacity's error is rounding: the middles of intervals integrate a ramp exactly."""
    return [
        _steps("opacity", "alpha", None),
        _steps("depth", "depth_sum", FINE),
        _steps("depth, samples where their intervals begin", "depth_sum", FINE, phase=0.0),
        _stops(),
    ]


def _steps(
    name: str, quantity: str, smooth: tuple[float, float] | None, phase: float = 0.5
) -> Experiment:
    y = (torch.arange(RAYS) + 0.5) / RAYS
    truth = exact(quantity, y.double())
    trials = [Trial(step, partial(_rendered, quantity, y, step, phase), truth) for step in STEPS]
    return Experiment(f"linear ramp: {name}", "step, sides of the cube", trials, smooth)


def _rendered(quantity: str, y: Tensor, step: float, phase: float) -> Tensor:
    """Opacity or depth [R] of the rays at `y` [R], by march and compositing, without early stop."""
    origins = torch.stack((torch.zeros_like(y), y, torch.full_like(y, 0.5)), dim=1)
    rays = Rays(origins, torch.eye(3)[:1].expand(len(y), 3))
    everywhere = Occupancy(torch.ones(16, 16, 16))
    samples = march(rays, everywhere, step, jitter=torch.full_like(y, phase))
    x, y, _ = samples.positions.unbind(dim=1)
    pixels = composite(slope(y) * x, torch.zeros(len(samples), 1), samples, stop=0.0)
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

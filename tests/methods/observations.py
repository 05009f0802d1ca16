"""What a 2D renderer is shown, made up at random."""

from __future__ import annotations

from dataclasses import replace
from typing import TypeVar

import torch
from torch import Tensor

from methods.rendering.frame import FeatureFrame
from methods.steernerf.buffer import Points
from methods.steernerf.unet import Observation, Renderer2d
from tests.methods.conftest import look_at_the_middle

CAMERA = look_at_the_middle(0.0, 0.0)  # no renderer looks at it
ROUNDING = 1e-12
"""Error of a network in float64: activations of size 1 to 10, sums of up to 2,000 products in
another order, a few tens of u = 1.1e-16 a layer, a few layers deep."""

POINTS = 20

AnyRenderer = TypeVar("AnyRenderer", bound=Renderer2d)


def observe(
    height: int = 5,
    width: int = 7,
    *,
    channels: int = 6,
    frames: int = 2,
    scale: int = 4,
    seed: int = 0,
) -> Observation:
    """Random features in steps of 1/256, and preceding points on a third of the pixels."""
    generator = torch.Generator().manual_seed(seed)
    values = torch.randint(257, (height, width, channels), generator=generator) / 256
    depth, alpha = torch.full((height, width), 1.5), torch.ones(height, width)
    points = torch.rand(POINTS, channels, generator=generator)
    size = frames, scale * height, scale * width
    index = torch.randint(POINTS, size, generator=generator, dtype=torch.int32)
    shown = torch.rand(size, generator=generator) < 0.33
    preceding = Points(points, torch.where(shown, index, -1))
    return Observation(FeatureFrame(CAMERA, values, depth, alpha), preceding, "auto")


def doubled(observation: Observation) -> Observation:
    """In float64, for the backend that takes it."""

    def twice(part):
        if isinstance(part, Tensor) and part.is_floating_point():
            return part.double()
        if isinstance(part, list):
            return [twice(one) for one in part]
        if isinstance(part, tuple):
            return tuple(map(twice, part))
        if isinstance(part, FeatureFrame | Points | Observation):
            return replace(part, **{name: twice(x) for name, x in vars(part).items()})
        return part

    return replace(twice(observation), backend="reference")


def shaken(renderer: AnyRenderer, seed: int = 0) -> AnyRenderer:
    """The renderer with no weight that is 0, as after some training."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in renderer.parameters():
            parameter.add_(0.02 * torch.randn(parameter.shape, generator=generator))
    return renderer

"""What a 2D renderer is shown, made up at random."""

from dataclasses import replace

import torch

from methods.rendering.frame import FeatureFrame
from methods.steernerf.buffer import Points
from methods.steernerf.unet import Observation, UNet
from tests.methods.conftest import look_at_the_middle

CAMERA = look_at_the_middle(0.0, 0.0)  # no renderer looks at it
ROUNDING = 1e-12
"""Error of a network in float64: activations of size 1 to 10, sums of up to 2,000 products in
another order, a few tens of u = 1.1e-16 a layer, a few layers deep."""

POINTS = 20


def observe(
    height: int = 5,
    width: int = 7,
    *,
    channels: int = 6,
    frames: int = 2,
    scale: int = 4,
    seed: int = 0,
) -> Observation:
    """Random features in steps of 1/256, and preceding points, of which some are not shown."""
    generator = torch.Generator().manual_seed(seed)
    values = torch.randint(257, (height, width, channels), generator=generator) / 256
    depth, alpha = torch.full((height, width), 1.5), torch.ones(height, width)
    size = scale**2 * height * width
    preceding = [
        Points(
            torch.rand(POINTS, channels, generator=generator),
            torch.randperm(size + POINTS, generator=generator)[:POINTS].clamp(max=size),
        )
        for _ in range(frames)
    ]
    return Observation(FeatureFrame(CAMERA, values, depth, alpha), preceding)


def doubled(observation: Observation) -> Observation:
    """In float64."""
    frame = observation.frame
    preceding = [replace(points, values=points.values.double()) for points in observation.preceding]
    return replace(
        observation, frame=replace(frame, values=frame.values.double()), preceding=preceding
    )


def shaken(renderer: UNet, seed: int = 0) -> UNet:
    """The renderer with no weight that is 0, as after some training."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in renderer.parameters():
            parameter.add_(0.02 * torch.randn(parameter.shape, generator=generator))
    return renderer

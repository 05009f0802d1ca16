"""What a 2D renderer is shown, made up at random, whole and cut."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, TypeVar

import torch
from torch import Tensor
from torch.nn import functional

from methods.rendering.frame import FeatureFrame
from methods.steernerf.buffer import Points
from methods.steernerf.unet import Observation, Renderer2d
from methods.steernerf_lean.cells import cells_near
from methods.steernerf_lean.lean_renderer import LeanRenderer
from methods.steernerf_lean.observation import LeanObservation
from tests.methods.conftest import look_at_the_middle

CAMERA = look_at_the_middle(0.0, 0.0)  # no renderer looks at it
BACKGROUND = torch.tensor([1.0, 1.0, 1.0, 0.5, 0.5, 0.5, 0.5, 0.5])
ROUNDING = 1e-12
"""Error of a network in float64: activations of size 1 to 10, sums of up to 2,000 products in
another order, a few tens of u = 1.1e-16 a layer, a few layers deep."""

FLOAT32_ERROR = 1e-5
"""Activations of size 1 to 10, sums of up to 400 products in another order: a few tens of u = 6e-8,
a few layers deep."""

POINTS = 20

AnyRenderer = TypeVar("AnyRenderer", bound=Renderer2d)
AnyObservation = TypeVar("AnyObservation", Observation, LeanObservation)


def observe(
    height: int = 5,
    width: int = 7,
    *,
    channels: int = 6,
    scale: int = 4,
    matter: Tensor | None = None,
    history: bool = True,
    seed: int = 0,
) -> LeanObservation:
    """Random features in steps of 1/256 where there is `matter` [h, w], the background elsewhere.

    The preceding picture, and the surface, are known in two thirds of the pixels of cells with
    matter. Points of the surface have an opacity, too.
    """
    frame, fine, generator = _frame(height, width, channels, scale, matter, seed)
    cells = cells_near(frame.alpha > 0).flatten().nonzero().squeeze(1)
    valid = torch.rand(height, width, scale**2, generator=generator) < 0.66
    valid = (valid & (frame.alpha > 0)[..., None]).float()
    picture = torch.rand(height, width, scale**2, 3, generator=generator) * valid[..., None]
    at_surface = _scattered(fine, 0.66, channels + 1, generator)
    index = to_blocks(at_surface.index[..., None], scale).squeeze(-1)
    return LeanObservation(
        frame,
        BACKGROUND[:channels],
        cells,
        Points(at_surface.values, index.flatten(0, 1)[cells]),
        (picture.flatten(0, 1)[cells], valid.flatten(0, 1)[cells]) if history else None,
        "auto",
    )


def observe_paper(
    height: int = 5,
    width: int = 7,
    *,
    channels: int = 6,
    frames: int = 2,
    scale: int = 4,
    seed: int = 0,
) -> Observation:
    """Random features in steps of 1/256, and preceding points on a third of the pixels."""
    frame, fine, generator = _frame(height, width, channels, scale, None, seed)
    each = fine.expand(frames, *fine.shape)
    return Observation(frame, _scattered(each, 0.33, channels, generator), "auto")


def _frame(
    height: int, width: int, channels: int, scale: int, matter: Tensor | None, seed: int
) -> tuple[FeatureFrame, Tensor, torch.Generator]:
    """A frame, its matter at full resolution, and the generator of its random numbers."""
    generator = torch.Generator().manual_seed(seed)
    if matter is None:
        matter = torch.ones(height, width, dtype=torch.bool)
    values = torch.randint(257, (height, width, channels), generator=generator) / 256
    values = torch.where(matter[..., None], values, BACKGROUND[:channels])
    fine = matter.repeat_interleave(scale, 0).repeat_interleave(scale, 1)
    frame = FeatureFrame(CAMERA, values, torch.where(matter, 1.5, torch.inf), matter.float())
    return frame, fine, generator


def _scattered(fine: Tensor, share: float, features: int, generator: torch.Generator) -> Points:
    points = torch.rand(POINTS, features, generator=generator)
    index = torch.randint(POINTS, fine.shape, generator=generator, dtype=torch.int32)
    shown = fine & (torch.rand(fine.shape, generator=generator) < share)
    return Points(points, torch.where(shown, index, -1))


def to_blocks(picture: Tensor, scale: int) -> Tensor:
    """[h s, w s, C] to [h, w, s^2, C]."""
    height, width, channels = picture.shape
    parts = picture.view(height // scale, scale, width // scale, scale, channels)
    return parts.transpose(1, 2).flatten(2, 3)


def everywhere(part: Tensor, observation: LeanObservation, otherwise: float = 0) -> Tensor:
    """[h, w, ...] of what is known of the cells [N, ...]."""
    height, width = observation.frame.alpha.shape
    whole = torch.full((height * width, *part.shape[1:]), otherwise, dtype=part.dtype)
    whole[observation.cells] = part
    return whole.view(height, width, *part.shape[1:])


def spot(height: int, width: int, row: int, column: int) -> Tensor:
    """Matter of 2 x 3 cells."""
    matter = torch.zeros(height, width, dtype=torch.bool)
    matter[row : row + 2, column : column + 3] = True
    return matter


def doubled(observation: AnyObservation) -> AnyObservation:
    """In float64, for the backend that takes it."""

    def twice(part):
        if isinstance(part, Tensor) and part.is_floating_point():
            return part.double()
        if isinstance(part, list):
            return [twice(one) for one in part]
        if isinstance(part, tuple):
            return tuple(map(twice, part))
        if isinstance(part, FeatureFrame | Points | LeanObservation | Observation):
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


def new_renderer(
    channels: int = 6, scale: int = 4, *, history: bool = True, **others: Any
) -> LeanRenderer:
    """An untrained lean renderer; `others` replace options."""
    options = {"width": 16, "blocks": 2, "init": "scratch"} | others
    return LeanRenderer(channels, int(history), scale, **options)


def to_picture(blocks: Tensor, scale: int) -> Tensor:
    """[h, w, s^2, C] to [h s, w s, C]."""
    height, width, _, channels = blocks.shape
    parts = blocks.view(height, width, scale, scale, channels).transpose(1, 2)
    return parts.reshape(height * scale, width * scale, channels)


def at_surface(observation: LeanObservation, scale: int) -> tuple[Tensor, Tensor]:
    """[H, W, K + 1] and [H, W]: what each pixel shows of the surface, and whether."""
    points, index = observation.surface.values, observation.surface.index
    shown = points[index.clamp(min=0).long()], (index >= 0).to(points)
    values, known = (everywhere(part, observation) for part in shown)
    return to_picture(values, scale), to_picture(known[..., None], scale)[..., 0]


def before(observation: LeanObservation, scale: int) -> tuple[Tensor, Tensor]:
    """[H, W, 3] and [H, W, 1]: the preceding picture, and where it is known."""
    assert observation.history is not None
    values, valid = (everywhere(part, observation) for part in observation.history)
    return to_picture(values, scale), to_picture(valid[..., None], scale)


def enlarged(observation: LeanObservation, scale: int) -> Tensor:
    """[H, W, 3]: the present colours, bilinear, the corners at the centres of corner pixels."""
    rgb = observation.frame.values[..., :3].permute(2, 0, 1)[None]
    large = functional.interpolate(rgb, scale_factor=scale, mode="bilinear", align_corners=False)
    return large[0].permute(1, 2, 0)

"""Patches of training views, rendered as far as the input of the 2D renderer."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any, Protocol

import torch
from torch import Tensor
from torch.nn import functional

from bench.cameras import cast, pixel_grid
from bench.compositing import composite
from bench.types import Camera, Rays
from methods.kernels.types import Pixels
from methods.rendering.batch import first_pass, second_pass
from methods.rendering.compaction import indices_where
from methods.rendering.frame import FeatureFrame, sees_matter
from methods.steernerf.renderer import Observation, Points
from methods.steernerf.training.examples import Example, ExamplePool
from methods.steernerf.training.options import JointOptions
from methods.steernerf.view import View


@dataclass(frozen=True)
class Patch:
    """A patch of a training view, and the rays of the field that it needs.

    Attributes:
        example: the example it was cut from.
        view: its cameras.
        truth: [H, W, 3] the true picture.
        points: the features of each preceding frame, reprojected into `view`.
        masks: which rays are rendered: of the pixels of `view.low` [h w], then, if the field learns
            from them, of the points [N] of each preceding frame.
    """

    example: Example
    view: View
    truth: Tensor
    points: Sequence[Points]
    masks: Sequence[Tensor]

    def rays(self, chosen: Sequence[Tensor]) -> Rays:
        """The rays of the `chosen` pixels and points, given as indices for each of `masks`."""
        pixels, *points = chosen
        shown = zip(self.example.buffer, points, strict=False)  # no points if none are learned from
        parts = [(cloud.camera, cloud.source[some]) for cloud, some in shown]
        return Rays.joined([_rays_of(*part) for part in [(self.view.low, pixels), *parts]])


@dataclass(frozen=True)
class Batch:
    """Patches to learn from.

    Attributes:
        observations: the renderer's input for each, with a gradient if the field learns.
        views: the cameras of each.
        truth: their true pictures, [B, H, W, 3].
        opacity: opacity of all rendered rays.
    """

    observations: Sequence[Any]
    views: Sequence[View]
    truth: Tensor
    opacity: Tensor


class PatchSource(Protocol):
    """A source of patches for a training."""

    def draw(self, count: int) -> Batch:
        """Draw `count` patches."""

    def state(self) -> dict[str, Tensor]:
        """What the next patches depend on, besides the pipeline and the random numbers."""

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Restore what `state` returned."""


class Patches:
    """Draws batches of random patches from the examples of a pool.

    Args:
        options: size of a patch, and whether its rays are jittered.
        learning: whether the field learns.
    """

    def __init__(
        self,
        pool: ExamplePool,
        options: JointOptions,
        learning: bool,
        generator: torch.Generator,
    ) -> None:
        self.pipeline, self.rendering = pool.pipeline, pool.rendering
        self.pool, self.options = pool, options
        self.learning, self.generator = learning, generator
        self.state, self.restore = pool.state, pool.restore

    def draw(self, count: int) -> Batch:
        """Draw `count` patches, each from an example of the pool."""
        patches = [self.cut(self.pool.draw()) for _ in range(count)]
        observations, opacity = self.observe(patches)
        truth = torch.stack([patch.truth for patch in patches])
        return Batch(observations, [patch.view for patch in patches], truth, opacity)

    def cut(self, example: Example) -> Patch:
        """Cut a random patch from `example`."""
        view, options = self.pipeline.view(example.truth.camera), self.options
        size = view.low.height, view.low.width
        largest = min(options.patch, max(1, int(options.patch_share * min(size))))
        height, width = (min(largest, side) for side in size)
        top, left = self.place(example, (height, width), size)
        cut = view.crop(left, top, width, height)
        seen = sees_matter(cut.low, self.pipeline.occupancy).flatten()
        points = self.points(example, cut)
        masks = [_shown(p.index, len(p.values)) for p in points] if self.learning else []
        truth = self._truth(example, top, left, cut.full)
        return Patch(example, cut, truth, points, [seen, *masks])

    def place(
        self, example: Example, extents: tuple[int, int], size: tuple[int, int]
    ) -> Sequence[int]:
        """Choose the first row and column of a patch of `extents` in a frame of `size`."""
        return [self.random(side - extent + 1) for extent, side in zip(extents, size, strict=True)]

    def points(self, example: Example, view: View) -> Sequence[Points]:
        """The features of the preceding frames that the 2D renderer is shown."""
        return [self.pipeline.reproject(cloud, view) for cloud in example.buffer]

    def _truth(self, example: Example, top: int, left: int, full: Camera) -> Tensor:
        """The true picture [H, W, 3] of the patch. Beyond the border of a picture whose sides are
        no multiples of the scale, its last row and column are repeated."""
        scale = self.pipeline.model.scale
        background = self.pipeline.background[:3]
        rows = slice(top * scale, top * scale + full.height)
        columns = slice(left * scale, left * scale + full.width)
        picture = example.truth.picture[rows, columns]
        part = composite(picture.to(background.device, non_blocking=True), background)
        missing = 0, full.width - part.shape[1], 0, full.height - part.shape[0]
        return functional.pad(part.movedim(-1, 0), missing, mode="replicate").movedim(0, -1)

    def observe(self, patches: Sequence[Patch]) -> tuple[Sequence[Any], Tensor]:
        """Compute the renderer's input for `patches`, with a gradient if the field learns, and the
        opacities of the rays."""
        masks = [mask for patch in patches for mask in patch.masks]
        found = indices_where(masks)
        chosen = list(_of_each(patches, found))
        rays = Rays.joined([p.rays(some) for p, some in zip(patches, chosen, strict=True)])
        field, how, jitter = self.pipeline.field, self.rendering.march, None
        if self.options.jitter:
            jitter = torch.rand(len(rays.origins), generator=self.generator)
            jitter = jitter.to(field.device, non_blocking=True)
        first = first_pass(field, rays, self.pipeline.occupancy, how, jitter=jitter)
        samples = first.visible()
        with torch.set_grad_enabled(self.learning):
            pixels = second_pass(field, rays, samples, how)
            rendered = _of_each(patches, _split(pixels, [len(some) for some in found]))
            given = list(zip(patches, chosen, rendered, strict=True))
            frames = [self._frame(patch, some[0], parts[0]) for patch, some, parts in given]
            learned = [self._learned(patch, some[1:], parts[1:]) for patch, some, parts in given]
            return self.observations(patches, frames, learned), pixels.alpha

    def observations(
        self,
        patches: Sequence[Patch],
        frames: Sequence[FeatureFrame],
        points: Sequence[Sequence[Points]],
    ) -> Sequence[Any]:
        """What the 2D renderer is shown of `patches`, whose present features are `frames` and whose
        preceding ones are `points`."""
        return [
            Observation(*both, self.pipeline.backend) for both in zip(frames, points, strict=True)
        ]

    def _learned(
        self, patch: Patch, shown: Sequence[Tensor], rendered: Sequence[Pixels]
    ) -> Sequence[Points]:
        """The preceding features of `patch`, those `shown` as `rendered` now, with a gradient."""
        if not shown:
            return patch.points
        background = self.pipeline.background
        return [
            replace(old, values=old.values.index_copy(0, some, pixels.over(background).values))
            for old, some, pixels in zip(patch.points, shown, rendered, strict=True)
        ]

    def _frame(self, patch: Patch, seen: Tensor, pixels: Pixels) -> FeatureFrame:
        """The frame of the whole patch, from its rendered pixels, those at indices `seen`."""
        low = patch.view.low
        parts = (pixels.values, pixels.depth_sum, pixels.alpha)
        size = low.height * low.width
        blanks = (part.new_zeros(size, *part.shape[1:]) for part in parts)
        canvas = Pixels(
            *(b.index_copy(0, seen, part) for b, part in zip(blanks, parts, strict=True))
        )
        frame = FeatureFrame.of(low, canvas, self.pipeline.background)
        return replace(frame, depth=frame.depth.detach())

    def random(self, below: int) -> int:
        """A random number of 0 to less than `below`."""
        return int(torch.randint(below, (), generator=self.generator))


def _of_each(patches: Iterable[Patch], parts: Iterable[Any]) -> Iterator[Sequence[Any]]:
    """Group `parts`, one for each mask of all patches, by patch."""
    following = iter(parts)
    return (list(islice(following, len(patch.masks))) for patch in patches)


def _shown(index: Tensor, count: int) -> Tensor:
    """Which of `count` points occur in `index`, which is -1 for none: [count] bool."""
    shown = torch.zeros(count + 1, dtype=torch.bool, device=index.device)
    return shown.index_fill_(0, index.flatten().long() % (count + 1), True)[:count]


def _rays_of(camera: Camera, pixels: Tensor) -> Rays:
    """Rays through the centres of `pixels` [P], counted row by row."""
    return cast(camera, pixel_grid(camera.width, camera.height, pixels.device)[pixels])


def _split(pixels: Pixels, sizes: list[int]) -> list[Pixels]:
    parts = (x.split(sizes) for x in (pixels.values, pixels.depth_sum, pixels.alpha))
    return [Pixels(*part) for part in zip(*parts, strict=True)]

"""Patches of training views, rendered as far as the input of the 2D renderer (Section 3.4)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from bench.cameras import cast, pixel_grid
from bench.types import Camera, Rays, composite
from methods.kernels.types import Pixels
from methods.rendering.batch import render_batch
from methods.rendering.compaction import indices_where
from methods.rendering.frame import FeatureFrame, sees_matter
from methods.steernerf.renderer import Observation, Points
from methods.steernerf.training.examples import Example, ExamplePool
from methods.steernerf.training.options import JointOptions
from methods.steernerf.view import View

Shown = tuple[FeatureFrame, Sequence[Points]]
"""The present features of a patch, and those of preceding frames."""


@dataclass(frozen=True)
class Patch:
    """A patch of a training view."""

    example: Example  # that it was cut from
    view: View  # its cameras
    truth: Tensor  # [H, W, 3] the true picture
    points: Sequence[Points]  # features of preceding frames, reprojected into `view`
    rendered: Sequence[tuple[Camera, Tensor]]  # cameras, and which of their pixels [h w] have rays:
    # `view.low`, then, if the field learns from them, the preceding frames


@dataclass(frozen=True)
class Batch:
    """Patches to learn from."""

    observations: Sequence[Any]  # the input of the 2D renderer; with a gradient if the field learns
    views: Sequence[View]
    truth: Tensor  # [B, H, W, 3] the true pictures
    opacity: Tensor  # [R] of all rendered rays


class Patches:
    """Draws batches of random patches from the examples of a pool; `learning` says whether the
    field learns. A subclass may override `place`, `points` and `observations`."""

    def __init__(
        self, pool: ExamplePool, options: JointOptions, learning: bool, generator: torch.Generator
    ) -> None:
        self.pipeline, self.rendering = pool.pipeline, pool.rendering
        self.pool, self.options = pool, options
        self.learning, self.generator = learning, generator

    def draw(self, count: int) -> Batch:
        """Draw `count` patches, each from an example of the pool."""
        patches = [self.cut(self.pool.draw()) for _ in range(count)]
        observations, opacity = self.observe(patches)
        truth = torch.stack([patch.truth for patch in patches])
        return Batch(observations, [patch.view for patch in patches], truth, opacity)

    def state(self) -> dict[str, Tensor]:
        """What the next patches depend on, besides the pipeline and the random numbers."""
        return self.pool.state()

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Restore what `state` returned."""
        self.pool.restore(tensors)

    def cut(self, example: Example) -> Patch:
        """Cut a random patch from `example`."""
        options, camera = self.options, self.pool.views.cameras[example.number]
        view = self.pipeline.view(camera)
        size = view.low.height, view.low.width
        largest = min(options.patch, max(1, int(options.patch_share * min(size))))
        height, width = (min(largest, side) for side in size)
        top, left = self.place(example, (height, width), size)
        cut = view.crop(left, top, width, height)
        points = self.points(example, cut)
        rendered = [(cut.low, sees_matter(cut.low, self.pipeline.occupancy).flatten())]
        if self.learning:
            shown = [_shown(old.index, len(old.values)) for old in points]
            rendered += zip([cloud.camera for cloud in example.buffer], shown, strict=False)
        return Patch(example, cut, self._truth(example, top, left, cut.full), points, rendered)

    def place(
        self, example: Example, extents: tuple[int, int], size: tuple[int, int]
    ) -> Sequence[int]:
        """Choose the first row and column of a patch of `extents` in a frame of `size`."""
        return [self.random(side - extent + 1) for extent, side in zip(extents, size, strict=True)]

    def points(self, example: Example, view: View) -> Sequence[Points]:
        """The features of preceding frames that the 2D renderer is shown in `view`."""
        return [self.pipeline.reproject(cloud, view) for cloud in example.buffer]

    def _truth(self, example: Example, top: int, left: int, full: Camera) -> Tensor:
        """The true picture [H, W, 3] of the patch. Beyond the border of a picture whose sides are
        no multiples of the scale, its last row and column are repeated."""
        scale, background = self.pipeline.model.scale, self.pipeline.background[:3]
        rows = slice(top * scale, top * scale + full.height)
        columns = slice(left * scale, left * scale + full.width)
        picture = self.pool.views.pictures[example.number][rows, columns].to(
            background.device, non_blocking=True
        )
        part = composite(picture, background)
        missing = 0, full.width - part.shape[1], 0, full.height - part.shape[0]
        return functional.pad(part.movedim(-1, 0), missing, mode="replicate").movedim(0, -1)

    def observe(self, patches: Sequence[Patch]) -> tuple[Sequence[Any], Tensor]:
        """Compute the input of the 2D renderer for `patches`, and the opacities of their rays."""
        rendered = [part for patch in patches for part in patch.rendered]
        chosen = indices_where([mask for _, mask in rendered])
        each = [_rays_of(camera, some) for (camera, _), some in zip(rendered, chosen, strict=True)]
        rays, field, jitter = Rays.joined(each), self.pipeline.field, None
        if self.options.jitter:
            jitter = torch.rand(len(rays.origins), generator=self.generator)
            jitter = jitter.to(field.device, non_blocking=True)
        with torch.set_grad_enabled(self.learning):
            how, occupancy = self.rendering.sampling, self.pipeline.occupancy
            pixels, _ = render_batch(field, rays, occupancy, how, jitter=jitter)
            ends = accumulate(len(some) for some in chosen)
            parts = (pixels.take(slice(e - len(x), e)) for x, e in zip(chosen, ends, strict=True))
            of_each = zip(chosen, parts, strict=True)
            shown: list[Shown] = []
            for patch in patches:
                frame, points = self._frame(patch.view.low, *next(of_each)), patch.points
                if self.learning:
                    points = [self._learned(old, *next(of_each)) for old in points]
                shown.append((frame, points))
            return self.observations(patches, shown), pixels.alpha

    def observations(self, patches: Sequence[Patch], shown: Sequence[Shown]) -> Sequence[Any]:
        """What the 2D renderer is shown of `patches`."""
        return [Observation(frame, points, self.pipeline.backend) for frame, points in shown]

    def _frame(self, low: Camera, seen: Tensor, pixels: Pixels) -> FeatureFrame:
        """The frame of the whole patch, from its rendered `pixels`, those at indices `seen`."""
        canvas = Pixels.blank(low.height * low.width, pixels.values.shape[1], seen.device)
        canvas.put(seen, pixels)
        frame = FeatureFrame.of(low, canvas, self.pipeline.background)
        return replace(frame, depth=frame.depth.detach())

    def _learned(self, old: Points, shown: Tensor, pixels: Pixels) -> Points:
        """Preceding features, those of the points `shown` as they are rendered now."""
        values = pixels.over(self.pipeline.background).values
        return replace(old, values=old.values.index_copy(0, shown, values))

    def random(self, below: int) -> int:
        """A random number of 0 to less than `below`."""
        return int(torch.randint(below, (), generator=self.generator))


def _shown(index: Tensor, count: int) -> Tensor:
    """Which of `count` points occur in `index`, which is -1 for none: [count] bool."""
    shown = torch.zeros(count + 1, dtype=torch.bool, device=index.device)
    return shown.index_fill_(0, index.flatten().long() % (count + 1), True)[:count]


def _rays_of(camera: Camera, pixels: Tensor) -> Rays:
    """Rays through the centres of `pixels` [P], counted row by row."""
    return cast(camera, pixel_grid(camera.width, camera.height, pixels.device)[pixels])

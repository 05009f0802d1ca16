"""Patches of training views, seen through the pipeline as far as a 2D renderer needs it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal, Protocol

import torch
from torch import Tensor

from bench.cameras import cast, pixel_grid
from bench.compositing import composite
from bench.types import Camera, NullProbe, Rays
from methods.kernels.composite import Pixels
from methods.rendering.batch import render_batch
from methods.rendering.compaction import places
from methods.rendering.frame import FeatureFrame, sees_matter
from methods.steernerf.renderer import Observation, Points
from methods.steernerf.training.options import JointOptions
from methods.steernerf.training.sequences import Sequence, SequencePool
from methods.steernerf.view import View

Through = Literal["all", "present", "none"]


@dataclass(frozen=True)
class Patch:
    """A patch of a training view, and which rays of the field it is drawn from.

    Attributes:
        sequence: what it was cut from.
        view: its cameras.
        truth: [H, W, 3].
        indices: what each preceding frame shows at its pixels, [H, W].
        masks: which rays are rendered: of the pixels of `view.low` [h w], then, if the field learns
            from them, of the points [N] of each preceding frame.
    """

    sequence: Sequence
    view: View
    truth: Tensor
    indices: list[Tensor]
    masks: list[Tensor]

    def rays(self, chosen: list[Tensor]) -> list[Rays]:
        """The rays of the `chosen` pixels and points, those where `masks` are true."""
        clouds = [frame.cloud for frame in self.sequence.buffer.frames]
        pixels, *points = chosen
        shown = zip(clouds, points, strict=False)  # no points if the field learns from none
        return [
            _rays_of(self.view.low, pixels),
            *(_rays_of(cloud.camera, cloud.source[some]) for cloud, some in shown),
        ]


@dataclass(frozen=True)
class Batch:
    """Patches to learn from.

    Attributes:
        observations: what is known of each, with a gradient if the field is to learn.
        views: the cameras of each.
        truth: their true pictures, [B, H, W, 3].
        opacity: of the rays that were rendered.
    """

    observations: list[Observation]
    views: list[View]
    truth: Tensor
    opacity: Tensor


class Patches(Protocol):
    """Where a training gets its patches from."""

    def draw(self, count: int) -> Batch:
        """`count` patches."""

    def state(self) -> dict[str, Tensor]:
        """What the next patches depend on, beside the pipeline and the random numbers."""

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Put back what `state` gave."""


class PatchSource:
    """Batches of random patches of the sequences of a pool.

    Args:
        options: how large a patch is, where it lies, and whether its rays are jittered.
        through: frames that the field learns from: "all", only the "present" one, or "none".
    """

    def __init__(
        self,
        pool: SequencePool,
        options: JointOptions,
        through: Through,
        generator: torch.Generator,
    ) -> None:
        self.pipeline, self.rendering = pool.pipeline, pool.rendering
        self.pool, self.options = pool, options
        self.through, self.generator = through, generator

    def draw(self, count: int) -> Batch:
        """See `Patches`."""
        patches = [self.cut(self.pool.draw()) for _ in range(count)]
        observations, opacity = self.observe(patches)
        truth = torch.stack([patch.truth for patch in patches])
        return Batch(observations, [patch.view for patch in patches], truth, opacity)

    def state(self) -> dict[str, Tensor]:
        """See `Patches`."""
        return self.pool.state()

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """See `Patches`."""
        self.pool.restore(tensors)

    def cut(self, sequence: Sequence) -> Patch:
        """A random patch of `sequence`."""
        view, options = sequence.view, self.options
        size = view.low.height, view.low.width
        largest = min(options.patch, max(1, int(options.patch_share * min(size))))
        height, width = (min(largest, side) for side in size)
        if options.place == "content":
            top, left = self._around_content(sequence, (height, width), size)
        else:
            top, left = self._random(size[0] - height + 1), self._random(size[1] - width + 1)
        cut = view.crop(left, top, width, height)
        seen = sees_matter(cut.low, self.pipeline.occupancy).flatten()
        truth = self._truth(sequence, top, left, cut.full)
        patch = Patch(sequence, cut, truth, [], [seen])
        for frame in sequence.buffer.frames:
            index = self.pipeline.reproject(frame.cloud, cut).index
            patch.indices.append(index)
            if self.through == "all":
                patch.masks.append(_shown(index, len(frame.cloud.points)))
        return patch

    def _around_content(
        self, sequence: Sequence, extents: tuple[int, int], size: tuple[int, int]
    ) -> list[int]:
        """The first row and column of a patch in which there is more than background."""
        place = sequence.cells[self._random(len(sequence.cells))].tolist()
        return [
            min(max(centre - self._random(extent), 0), side - extent)
            for centre, extent, side in zip(place, extents, size, strict=True)
        ]

    def _truth(self, sequence: Sequence, top: int, left: int, full: Camera) -> Tensor:
        """The true picture [H, W, 3] of the patch; the background where it ends."""
        scale = self.pipeline.model.scale
        background = self.pipeline.background[:3]
        rows = slice(top * scale, top * scale + full.height)
        columns = slice(left * scale, left * scale + full.width)
        picture = sequence.truth.picture[rows, columns]
        part = composite(picture.to(background.device, non_blocking=True), background)
        truth = background.expand(full.height, full.width, 3).clone()
        truth[: part.shape[0], : part.shape[1]] = part
        return truth

    def observe(self, patches: list[Patch]) -> tuple[list[Observation], Tensor]:
        """What the renderer is given of `patches`, with the gradient it is to have; opacities."""
        found = iter(places([mask for patch in patches for mask in patch.masks]))
        chosen = [(patch, [next(found) for _ in patch.masks]) for patch in patches]
        rays = [part for patch, some in chosen for part in patch.rays(some)]
        together = Rays.joined(rays)
        pipeline, count = self.pipeline, len(together.origins)
        device = together.origins.device
        jitter = None
        if self.options.jitter:
            jitter = torch.rand(count, generator=self.generator).to(device, non_blocking=True)
        with torch.set_grad_enabled(self.through != "none"):
            pixels, _ = render_batch(
                pipeline.field,
                together,
                pipeline.occupancy,
                self.rendering.march,
                jitter=jitter,
            )
            parts = iter(_split(pixels, [len(r.origins) for r in rays]))
            observations = [
                self._observation(patch, some, [next(parts) for _ in some])
                for patch, some in chosen
            ]
        return observations, pixels.alpha

    def _observation(
        self, patch: Patch, chosen: list[Tensor], rendered: list[Pixels]
    ) -> Observation:
        """Of the pixels and points that were `chosen` and `rendered`."""
        (pixels, present), *preceding = zip(chosen, rendered, strict=True)
        frame = self._spread(patch, pixels, present)
        frames = patch.sequence.buffer.frames
        values = [frame.cloud.values for frame in frames]
        for age, (shown, found) in enumerate(preceding):
            rendered_values = found.over(self.pipeline.background).values
            values[age] = values[age].index_copy(0, shown, rendered_values)
        points = [Points(v, i) for v, i in zip(values, patch.indices, strict=True)]
        newest = frames[0] if frames else None
        return self.pipeline.observe(frame, points, newest, patch.view, self.rendering, NullProbe())

    def _spread(self, patch: Patch, seen: Tensor, pixels: Pixels) -> FeatureFrame:
        """All pixels of the patch, from those `seen`, which were rendered."""
        low = patch.view.low

        def spread(part: Tensor) -> Tensor:
            blank = part.new_zeros(low.height * low.width, *part.shape[1:])
            return blank.index_copy(0, seen, part)

        canvas = Pixels(spread(pixels.values), spread(pixels.depth_sum), spread(pixels.alpha))
        frame = FeatureFrame.of(low, canvas, self.pipeline.background)
        return replace(frame, depth=frame.depth.detach())

    def _random(self, below: int) -> int:
        return int(torch.randint(below, (), generator=self.generator))


def _shown(index: Tensor, count: int) -> Tensor:
    """Which of `count` points stand in `index`, -1 for none: [count] bool."""
    shown = torch.zeros(count + 1, dtype=torch.bool, device=index.device)
    return shown.index_fill_(0, index.flatten().long() % (count + 1), True)[:count]


def _rays_of(camera: Camera, pixels: Tensor) -> Rays:
    """Rays through the centres of `pixels` [P], counted row by row."""
    return cast(camera, pixel_grid(camera.width, camera.height, pixels.device)[pixels])


def _split(pixels: Pixels, sizes: list[int]) -> list[Pixels]:
    parts = (x.split(sizes) for x in (pixels.values, pixels.depth_sum, pixels.alpha))
    return [Pixels(*part) for part in zip(*parts, strict=True)]

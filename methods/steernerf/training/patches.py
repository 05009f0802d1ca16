"""Patches of training views, rendered as far as the input of the 2D renderer."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Literal, Protocol, TypeVar

import torch
from torch import Tensor
from torch.nn import functional

from bench.cameras import cast, pixel_grid
from bench.compositing import composite
from bench.types import Camera, NullProbe, Rays
from methods.kernels.march import sample_counts
from methods.kernels.types import Extent, Pixels, Samples
from methods.rendering.batch import FirstPass, first_pass, second_pass
from methods.rendering.compaction import compacts, indices_where, to_host
from methods.rendering.frame import FeatureFrame, sees_matter
from methods.steernerf.renderer import Observation, Points, near_matter
from methods.steernerf.training.options import JointOptions
from methods.steernerf.training.sequences import Sequence, SequencePool
from methods.steernerf.view import View

T = TypeVar("T")
Through = Literal["all", "present", "none"]


@dataclass(frozen=True)
class Patch:
    """A patch of a training view, and the rays of the field that it needs.

    Attributes:
        sequence: the sequence it was cut from.
        view: its cameras.
        truth: [H, W, 3] the true picture.
        indices: for each preceding frame, the point that each pixel shows, [H, W].
        masks: which rays are rendered: of the pixels of `view.low` [h w], then, if the field learns
            from them, of the points [N] of each preceding frame.
    """

    sequence: Sequence
    view: View
    truth: Tensor
    indices: list[Tensor]
    masks: list[Tensor]

    def rays(self, chosen: list[Tensor]) -> list[Rays]:
        """The rays of the `chosen` pixels and points, given as indices for each of `masks`."""
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
        observations: the renderer's input for each, with a gradient if the field learns.
        views: the cameras of each.
        truth: their true pictures, [B, H, W, 3].
        opacity: opacity of all rendered rays.
    """

    observations: list[Observation]
    views: list[View]
    truth: Tensor
    opacity: Tensor


class Patches(Protocol):
    """A source of patches for a training."""

    def draw(self, count: int) -> Batch:
        """Draw `count` patches."""

    def state(self) -> dict[str, Tensor]:
        """What the next patches depend on, besides the pipeline and the random numbers."""

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Restore what `state` returned."""


class PatchSource:
    """Draws batches of random patches from the sequences of a pool.

    Args:
        options: size and place of a patch, and whether its rays are jittered.
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
        """Cut a random patch from `sequence`."""
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
        """Choose the first row and column of a patch that shows more than background."""
        place = sequence.cells[self._random(len(sequence.cells))].tolist()
        return [
            min(max(centre - self._random(extent), 0), side - extent)
            for centre, extent, side in zip(place, extents, size, strict=True)
        ]

    def _truth(self, sequence: Sequence, top: int, left: int, full: Camera) -> Tensor:
        """The true picture [H, W, 3] of the patch. Beyond the border of a picture whose sides are
        no multiples of the scale, its last row and column are repeated."""
        scale = self.pipeline.model.scale
        background = self.pipeline.background[:3]
        rows = slice(top * scale, top * scale + full.height)
        columns = slice(left * scale, left * scale + full.width)
        picture = sequence.truth.picture[rows, columns]
        part = composite(picture.to(background.device, non_blocking=True), background)
        missing = 0, full.width - part.shape[1], 0, full.height - part.shape[0]
        return functional.pad(part.movedim(-1, 0), missing, mode="replicate").movedim(0, -1)

    def observe(self, patches: list[Patch]) -> tuple[list[Observation], Tensor]:
        """Compute the renderer's input for `patches`, with a gradient as `through` says, and the
        opacities of the rays."""
        found, rays, extent = self._rays(patches)
        chosen = _of_each(patches, found)
        field, occupancy = self.pipeline.field, self.pipeline.occupancy
        how, jitter = self.rendering.sampling, self._jitter(len(rays.origins), self.generator)
        first = first_pass(field, rays, occupancy, how, jitter=jitter, extent=extent)
        samples, cells = self._visible(first, patches, chosen)
        with torch.set_grad_enabled(self.through != "none"):
            pixels = second_pass(field, rays, samples, how)
            rendered = _of_each(patches, _split(pixels, [len(some) for some in found]))
            observations = list(map(self._observation, patches, chosen, rendered, cells))
        return observations, pixels.alpha

    def _rays(self, patches: list[Patch]) -> tuple[list[Tensor], Rays, Extent | None]:
        """The indices where the masks of all patches are true, and the rays of these entries.

        On a GPU the number of rays and the extent of their samples are read back together.
        """
        masks = [mask for patch in patches for mask in patch.masks]
        if compacts(masks[0].device):
            chosen = indices_where(masks)
            return chosen, _joined(patches, chosen), None
        which = torch.cat(masks)
        every = [torch.arange(len(mask), device=mask.device) for mask in masks]
        rays = _joined(patches, every)
        # From a clone: `observe` draws the same phases again, for the chosen rays alone.
        jitter = self._jitter(len(which), self.generator.clone_state())
        if jitter is not None:
            jitter = jitter[(which.cumsum(0) - 1).clamp(min=0)]
        counts = sample_counts(
            rays,
            self.pipeline.occupancy,
            self.rendering.sampling.step,
            jitter=jitter,
            start=which.int() - 1,
            backend=self.pipeline.backend,
        )
        sizes, extent = _asked(masks, counts)
        (together,) = indices_where([which], [sum(sizes)])
        return indices_where(masks, sizes), rays.take(together), extent

    def _jitter(self, rays: int, generator: torch.Generator) -> Tensor | None:
        """Random phases of the samples of each ray; None if they are not random."""
        if not self.options.jitter:
            return None
        device = self.pipeline.field.device
        return torch.rand(rays, generator=generator).to(device, non_blocking=True)

    def _visible(
        self, first: FirstPass, patches: list[Patch], chosen: list[list[Tensor]]
    ) -> tuple[Samples, list[Tensor] | list[None]]:
        """The samples that are not hidden, and the cells near matter of each patch. On a GPU the
        numbers of both are read back together."""
        if compacts(self.pipeline.field.device) or not self.pipeline.leaves_out(self.rendering):
            return first.visible(), [None] * len(patches)
        opaque = first.opaque().split([len(some) for x in chosen for some in x])
        near = [
            near_matter(_spread(patch, pixels, seen), patch.indices).flatten()
            for patch, (pixels, *_), (seen, *_) in zip(
                patches, chosen, _of_each(patches, opaque), strict=True
            )
        ]
        sizes, extent = _asked(near, first.counts)
        return first.visible(extent), indices_where(near, sizes)

    def _observation(
        self, patch: Patch, chosen: list[Tensor], rendered: list[Pixels], cells: Tensor | None
    ) -> Observation:
        """The observation of `patch`, from the `chosen` pixels and points as `rendered`."""
        (pixels, present), *preceding = zip(chosen, rendered, strict=True)
        frame = self._frame(patch, pixels, present)
        frames = patch.sequence.buffer.frames
        values = [frame.cloud.values for frame in frames]
        for age, (shown, found) in enumerate(preceding):
            rendered_values = found.over(self.pipeline.background).values
            values[age] = values[age].index_copy(0, shown, rendered_values)
        points = [Points(v, i) for v, i in zip(values, patch.indices, strict=True)]
        newest = frames[0] if frames else None
        rendering, probe = self.rendering, NullProbe()
        return self.pipeline.observe(frame, points, newest, patch.view, rendering, probe, cells)

    def _frame(self, patch: Patch, seen: Tensor, pixels: Pixels) -> FeatureFrame:
        """The frame of the whole patch, from its rendered pixels, those at indices `seen`."""
        parts = (pixels.values, pixels.depth_sum, pixels.alpha)
        canvas = Pixels(*(_spread(patch, seen, part).flatten(0, 1) for part in parts))
        frame = FeatureFrame.of(patch.view.low, canvas, self.pipeline.background)
        return replace(frame, depth=frame.depth.detach())

    def _random(self, below: int) -> int:
        return int(torch.randint(below, (), generator=self.generator))


def _spread(patch: Patch, seen: Tensor, part: Tensor) -> Tensor:
    """Scatter `part` [P, ...] to the pixels `seen` [P] of the patch, 0 elsewhere: [h, w, ...]."""
    low = patch.view.low
    blank = part.new_zeros(low.height * low.width, *part.shape[1:])
    return blank.index_copy(0, seen, part).unflatten(0, (low.height, low.width))


def _of_each(patches: list[Patch], parts: Iterable[T]) -> list[list[T]]:
    """Group `parts`, one for each mask of all patches, by patch."""
    following = iter(parts)
    return [[next(following) for _ in patch.masks] for patch in patches]


def _joined(patches: list[Patch], chosen: list[Tensor]) -> Rays:
    """Join the rays of what is `chosen` for each mask of all patches."""
    parts = zip(patches, _of_each(patches, chosen), strict=True)
    return Rays.joined([rays for patch, some in parts for rays in patch.rays(some)])


def _asked(masks: list[Tensor], counts: Tensor) -> tuple[list[int], Extent]:
    """How many entries of each mask are true, and the extent of samples with `counts` [R]. The host
    waits for a GPU once."""
    *sizes, total, longest = to_host(
        [*(mask.sum() for mask in masks), Extent.figures(counts[None])]
    )
    return sizes, Extent(total, longest)


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

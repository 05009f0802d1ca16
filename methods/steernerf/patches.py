"""What stage 2 learns from: patches of training views, and the frames before them (Section 3.4).

Training views are scattered, so the preceding cameras are synthetic: a random smooth motion that
ends at the view. The pipeline renders these frames with its present weights, as it does when it is
used. After a number of patches they are rendered again, along another motion.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from bench.cameras import cast, pack_camera, pixel_grid, place_camera, unpack_camera
from bench.motion import novel_view, preceding, viewing_target
from bench.provenance import digest
from bench.sharing import missing
from bench.types import Budget, Camera, Log, NullProbe, Rays, Scene, Split, composite
from methods.instant_ngp.stage1 import Setup, TrainedField
from methods.kernels.types import Pixels
from methods.rendering.batch import render_batch
from methods.rendering.compaction import indices_where
from methods.rendering.frame import FeatureFrame, everywhere, render_frame, sees_matter
from methods.steernerf.buffer import Buffer, PointCloud, Points
from methods.steernerf.options import JointOptions
from methods.steernerf.pipeline import Pipeline, View
from methods.steernerf.unet import Observation
from methods.training import checkpoint


def distilled_views(
    setup: Setup, trained: TrainedField, scene: Scene, budget: Budget, count: int, log: Log
) -> tuple[Split, float]:
    """Render `count` random views among the training cameras with `trained`, at full resolution,
    or load them if they were rendered before; also return the seconds that took (Section 3.5)."""
    if not count:
        return Split([], [], []), 0.0
    key = {**setup.key(scene, budget), "views": count, "distillation": digest(distilled_views)}
    path = log.stage_dir("distilled", key) / "views.safetensors"
    generator = torch.Generator().manual_seed(setup.seed)
    taken, target = scene.splits["train"].cameras, viewing_target(scene)
    cameras = [novel_view(taken, target, generator) for _ in range(count)]
    names = [str(number) for number in range(count)]
    with missing(path, log) as to_render:
        if to_render:
            began, pictures, probe = time.monotonic(), {}, NullProbe()
            field, occupancy = trained.field, trained.occupancy
            background = scene.background.to(field.device)
            render = everywhere(field, occupancy, probe, trained.sampling)
            with log.progress("distilling", count) as progress:
                for name, camera in zip(names, cameras, strict=True):
                    placed = place_camera(camera, field.device)
                    rgb = render_frame(placed, occupancy, background, probe, render).values
                    pictures[name] = (rgb.clamp(0, 1) * 255).round().to(torch.uint8).cpu()
                    progress.advance()
            checkpoint.write(path, pictures, {"seconds": time.monotonic() - began})
    pictures, figures = checkpoint.read(path)
    with checkpoint.restoring(path):
        return Split(cameras, [pictures[name] for name in names], names), figures["seconds"]


@dataclass
class Example:
    """A training view and the frames that precede it."""

    number: int  # of the view
    buffer: Buffer  # the preceding frames
    uses: int  # patches that may still be cut from it
    lasting: bool  # whether it is then continued instead of replaced


class Examples:
    """A pool of examples that end in random views, those of `scene` and `distilled` ones. The
    frames before a view are rendered by `pipeline`; `options.motion` says when an example is
    replaced; `generator` is the source of all random numbers."""

    def __init__(
        self,
        pipeline: Pipeline,
        scene: Scene,
        distilled: Split,
        options: JointOptions,
        generator: torch.Generator,
    ) -> None:
        self.pipeline, self.rendering = pipeline, options.rendering(pipeline.model)
        self.options, self.learning = options, options.field == "joint"
        self.generator, self._pool = generator, list[Example]()
        real, self._target = scene.splits["train"], viewing_target(scene)
        self.cameras = [*real.cameras, *distilled.cameras]
        self.pictures = [*real.images, *distilled.images]
        self._real, self._distilled = len(real), len(distilled)

    def example(self) -> Example:
        """Draw an example from the pool; counts as one use."""
        place = min(self.random(self.options.motion.pool), len(self._pool))
        old = self._pool[place] if place < len(self._pool) else None
        if old is None or old.uses <= 0:
            self._pool[place : place + 1] = [self._following(old)]
        self._pool[place].uses -= 1
        return self._pool[place]

    def _following(self, old: Example | None) -> Example:
        """Continue a lasting `old` example, there and back from its view, or begin another one."""
        options, frames = self.options, self.pipeline.model.frames
        if old and old.lasting:
            number, buffer = old.number, old.buffer.copy()
            back = self._before(number)  # half of it and back: the view is again the last frame
            back = back[len(back) // 2 :]
            path = [self.cameras[number], *reversed(back), *back[1:]]
        else:
            distilled = self._chance() < options.distilled_share and self._distilled > 0
            number = self.random(self._distilled if distilled else self._real)
            number += self._real if distilled else 0
            path, buffer = self._before(number), Buffer(maxlen=frames)
        if frames:
            for camera in path:
                self.pipeline.remember(camera, buffer, self.rendering)
        # Without preceding frames, continuing would only repeat the view.
        lasting = self._chance() < options.motion.longer and frames > 0
        return Example(number, buffer, options.motion.uses, lasting)

    def _before(self, number: int) -> list[Camera]:
        """A random motion that ends at a view."""
        motion, view = self.options.motion, self.cameras[number]
        count = motion.least + self.random(motion.length - motion.least + 1)
        return preceding(view, self._target, count, motion.degrees, self.generator)

    def _chance(self) -> float:
        return torch.rand((), generator=self.generator).item()

    def random(self, below: int) -> int:
        """A random number of 0 to less than `below`."""
        return int(torch.randint(below, (), generator=self.generator))

    def state(self) -> dict[str, Tensor]:
        """All examples, to be kept in a file."""
        tensors = {}
        for place, example in enumerate(self._pool):
            figures = example.number, example.uses, example.lasting
            tensors[f"{place}.figures"] = torch.tensor(figures)
            for age, cloud in enumerate(example.buffer):
                for name, x in vars(cloud).items():
                    packed = pack_camera(x) if isinstance(x, Camera) else x
                    tensors[f"{place}.{age}.{name}"] = packed
        return tensors

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Restore the examples that `state` returned, with the same views and options."""
        self._pool = []
        while example := checkpoint.part(tensors, f"{len(self._pool)}."):
            number, uses, lasting = example["figures"].tolist()
            buffer = Buffer(maxlen=self.pipeline.model.frames)
            while cloud := checkpoint.part(example, f"{len(buffer)}."):
                parts = {name: self._unpacked(x) for name, x in cloud.items()}
                buffer.append(PointCloud(**parts))
            self._pool.append(Example(number, buffer, uses, bool(lasting)))

    def _unpacked(self, x: Tensor) -> Any:
        """A part of a cloud, of which only cameras are kept in float64, on the device."""
        device = self.pipeline.background.device
        return place_camera(unpack_camera(x), device) if x.dtype == torch.float64 else x.to(device)


@dataclass(frozen=True)
class Patch:
    """A patch of the view that an example ends in."""

    example: Example
    view: View
    truth: Tensor  # [H, W, 3] the true picture
    points: Sequence[Points]  # features of preceding frames, as `view` shows them


@dataclass(frozen=True)
class Batch:
    """Patches to learn from."""

    observations: Sequence[Any]  # the input of the 2D renderer; with a gradient if the field learns
    views: Sequence[View]
    truth: Tensor  # [B, H, W, 3] the true pictures
    opacity: Tensor  # [R] of all rendered rays


class Patches(Examples):
    """Batches of random patches, each cut from an example. A subclass may override `place` and
    `observations`."""

    def draw(self, count: int) -> Batch:
        """Draw `count` patches."""
        return self.render([self.cut(self.example()) for _ in range(count)])

    def cut(self, example: Example) -> Patch:
        """Cut a random square from `example`."""
        view, side = self.pipeline.view(self.cameras[example.number]), self._side
        top, left = self.place(example, side, (view.low.height, view.low.width))
        cut = view.crop((slice(top, top + side), slice(left, left + side)))
        truth = self._truth(example, top, left, cut.full)
        points = [cloud.shown_in(cut.full, self.pipeline.backend) for cloud in example.buffer]
        return Patch(example, cut, truth, points)

    @cached_property
    def _side(self) -> int:
        """The side of all patches, in low-resolution pixels; even the smallest picture has one."""
        shortest = min(min(camera.width, camera.height) for camera in self.cameras)
        share = self.options.patch_share * -(-shortest // self.pipeline.model.scale)
        return min(self.options.patch, max(1, int(share)))

    def place(self, example: Example, side: int, size: tuple[int, int]) -> Sequence[int]:
        """Choose the first row and column of a patch of `side` in a frame of `size` h, w."""
        return [self.random(extent - side + 1) for extent in size]

    def _truth(self, example: Example, top: int, left: int, full: Camera) -> Tensor:
        """The true picture [H, W, 3] of the patch. Beyond the border of a picture whose sides are
        no multiples of the scale, its last row and column are repeated."""
        scale, background = self.pipeline.model.scale, self.pipeline.background[:3]
        rows = slice(top * scale, top * scale + full.height)
        columns = slice(left * scale, left * scale + full.width)
        picture = self.pictures[example.number][rows, columns]
        part = composite(picture.to(background.device, non_blocking=True), background)
        beyond = 0, full.width - part.shape[1], 0, full.height - part.shape[0]
        return functional.pad(part.movedim(-1, 0), beyond, mode="replicate").movedim(0, -1)

    def render(self, patches: Sequence[Patch]) -> Batch:
        """Render `patches` as far as the input of the 2D renderer."""
        parts = [part for patch in patches for part in self._rendered(patch)]
        chosen = indices_where([mask for _, mask in parts])
        each = [
            cast(camera, pixel_grid(camera.width, camera.height, some.device)[some])
            for (camera, _), some in zip(parts, chosen, strict=True)
        ]
        rays, field, jitter = Rays.joined(each), self.pipeline.field, None
        if self.options.jitter:
            jitter = torch.rand(len(rays.origins), generator=self.generator)
            jitter = jitter.to(field.device, non_blocking=True)
        with torch.set_grad_enabled(self.learning):
            how, occupancy = self.rendering.sampling, self.pipeline.occupancy
            pixels, _ = render_batch(field, rays, occupancy, how, jitter=jitter)
            ends = accumulate(map(len, chosen))
            of_each = (  # in the order of `_rendered`
                (some, pixels.take(slice(end - len(some), end)))
                for some, end in zip(chosen, ends, strict=True)
            )
            shown = []
            for patch in patches:
                frame, points = self._frame(patch.view.low, *next(of_each)), patch.points
                if self.learning:
                    points = [self._learned(old, *next(of_each)) for old in points]
                shown.append(Observation(frame, points))
            observations = self.observations(patches, shown)
        truth = torch.stack([patch.truth for patch in patches])
        return Batch(observations, [patch.view for patch in patches], truth, pixels.alpha)

    def observations(self, patches: Sequence[Patch], shown: Sequence[Observation]) -> Sequence[Any]:
        """What the 2D renderer is shown of `patches`: all that is `shown`."""
        return shown

    def _rendered(self, patch: Patch) -> Iterator[tuple[Camera, Tensor]]:
        """Cameras, and which of their pixels [h w] are rendered: the present one and, if the field
        learns from them, those of the preceding frames."""
        low = patch.view.low
        yield low, sees_matter(low, self.pipeline.occupancy).flatten()
        if self.learning:
            pixels = patch.view.full.width * patch.view.full.height
            for cloud, points in zip(patch.example.buffer, patch.points, strict=True):
                yield cloud.camera, points.pixel < pixels

    def _frame(self, low: Camera, seen: Tensor, pixels: Pixels) -> FeatureFrame:
        """The frame of the whole patch, from its rendered `pixels`, those at indices `seen`."""
        canvas = Pixels.blank(low.height * low.width, pixels.values.shape[1], seen.device)
        canvas.put(seen, pixels)
        frame = FeatureFrame.of(low, canvas, self.pipeline.background)
        return replace(frame, depth=frame.depth.detach())

    def _learned(self, old: Points, seen: Tensor, pixels: Pixels) -> Points:
        """Points whose features, of those at indices `seen`, are as rendered now."""
        values = pixels.over(self.pipeline.background).values
        return replace(old, values=old.values.index_copy(0, seen, values))

"""What stage 2 learns from: patches of training views, and the frames before them (Section 3.4).

Training views are scattered, so the preceding cameras are synthetic: a random smooth motion that
ends at the view. The pipeline renders these frames with its present weights, as it does when it is
used. After a number of patches they are replaced, by those before another view.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate

import torch
from torch import Tensor
from torch.nn import functional

from bench.cameras import cast, pack_camera, pixel_grid, place_camera, unpack_camera
from bench.motion import preceding, viewing_target
from bench.types import Camera, Rays, Scene, Split, composite
from methods.kernels.types import Pixels
from methods.rendering.batch import render_batch
from methods.rendering.compaction import indices_where
from methods.rendering.frame import FeatureFrame, sees_matter
from methods.steernerf.buffer import Buffer, PointCloud, Points
from methods.steernerf.options import JointOptions
from methods.steernerf.pipeline import Pipeline, TwoScales
from methods.steernerf.unet import Observation
from methods.training import checkpoint
from methods.training.checkpoint import Tensors

Rendered = Iterator[tuple[Tensor, Pixels]]
"""Indices of pixels of a frame, and those pixels, frame by frame."""


@dataclass
class Example:
    """A training view and the frames that precede it."""

    number: int  # of the view
    buffer: Buffer  # the preceding frames
    uses: int  # patches that may still be cut from it


@dataclass(frozen=True)
class Patch:
    """A patch of the view that an example ends in."""

    example: Example
    view: TwoScales
    truth: Tensor  # [H, W, 3] the true picture, NaN where pixels do not count
    points: Sequence[Points]  # features of the preceding frames, where `view` shows them


@dataclass(frozen=True)
class Batch:
    """Patches to learn from."""

    observations: Sequence[Observation]  # with a gradient if the field learns
    truth: Tensor  # [B, H, W, 3] the true pictures, NaN where pixels do not count
    opacity: Tensor  # [R] of all rendered rays


class Patches:
    """Batches of random patches of the views of `scene` and of `distilled` ones. Each is cut from
    an example, one of a pool, whose preceding frames are rendered by `pipeline`; `generator` is the
    source of all random numbers."""

    def __init__(
        self,
        pipeline: Pipeline,
        scene: Scene,
        distilled: Split,
        options: JointOptions,
        generator: torch.Generator,
    ) -> None:
        self.pipeline = pipeline
        self.rendering = options.rendering(pipeline.model)
        self.options = options
        self.learning = options.field == "joint"
        self.generator = generator
        self._pool = list[Example]()
        real = scene.splits["train"]
        self._target = viewing_target(scene)
        self.cameras = [*real.cameras, *distilled.cameras]
        self.pictures = [*real.images, *distilled.images]
        self.masks = [*(real.masks or [None] * len(real)), *[None] * len(distilled)]
        self._real = len(real)
        self._distilled = len(distilled)
        shortest = min(min(camera.size) for camera in self.cameras)
        # Of all patches, in low-resolution pixels; even the smallest picture has one.
        self._side = min(options.patch, -(-shortest // pipeline.model.scale))

    def draw(self, count: int) -> Batch:
        """Draw `count` patches."""
        return self.render([self.cut(self.example()) for _ in range(count)])

    def example(self) -> Example:
        """Draw an example from the pool; counts as one use."""
        place = min(self._random(self.options.motion.pool), len(self._pool))
        if place == len(self._pool) or not self._pool[place].uses:
            self._pool[place : place + 1] = [self._another()]
        self._pool[place].uses -= 1
        return self._pool[place]

    def _another(self) -> Example:
        """An example of a random view, behind L frames of a random motion."""
        options, frames = self.options, self.pipeline.model.frames
        distilled = self._chance() < options.distilled_share and self._distilled > 0
        number = self._random(self._distilled if distilled else self._real)
        number += self._real if distilled else 0
        # This number, and that after the loop, are not used: without them, all others would change.
        self._random(1)
        view, buffer, degrees = self.cameras[number], Buffer(maxlen=frames), options.motion.degrees
        for camera in preceding(view, self._target, frames, degrees, self.generator):
            self.pipeline.remember(camera, buffer, self.rendering)
        self._chance()
        return Example(number, buffer, options.motion.uses)

    def _chance(self) -> float:
        return torch.rand((), generator=self.generator).item()

    def _random(self, below: int) -> int:
        """A random number of 0 to less than `below`."""
        return int(torch.randint(below, (), generator=self.generator))

    def cut(self, example: Example) -> Patch:
        """Cut a random square from `example`."""
        view, side = self.pipeline.view(self.cameras[example.number]), self._side
        top, left = (self._random(size - side + 1) for size in (view.low.height, view.low.width))
        cut = view.crop((slice(top, top + side), slice(left, left + side)))
        truth = self._truth(example, top, left, cut.full)
        return Patch(example, cut, truth, [cloud.shown_in(cut.full) for cloud in example.buffer])

    def _truth(self, example: Example, top: int, left: int, full: Camera) -> Tensor:
        """The true picture [H, W, 3] of the patch. Beyond the border of a picture whose sides are
        no multiples of the scale, its last row and column are repeated."""
        scale, background = self.pipeline.model.scale, self.pipeline.background[:3]
        rows = slice(top * scale, top * scale + full.height)
        columns = slice(left * scale, left * scale + full.width)
        picture = self.pictures[example.number][rows, columns]
        part = composite(picture.to(background.device, non_blocking=True), background)
        if (mask := self.masks[example.number]) is not None:
            part[~mask[rows, columns].to(part.device)] = math.nan
        beyond = 0, full.width - part.shape[1], 0, full.height - part.shape[0]
        return functional.pad(part.movedim(-1, 0), beyond, mode="replicate").movedim(0, -1)

    def render(self, patches: Sequence[Patch]) -> Batch:
        """Render `patches` as far as the input of the 2D renderer; rays of all go together."""
        parts = [part for patch in patches for part in self._to_render(patch)]
        chosen = indices_where([mask for _, mask in parts])
        each = [
            cast(camera, pixel_grid(*camera.size, some.device)[some])
            for (camera, _), some in zip(parts, chosen, strict=True)
        ]
        rays = Rays.joined(each)
        field = self.pipeline.field
        jitter = None
        if self.options.jitter:
            jitter = torch.rand(len(rays.origins), generator=self.generator)
            jitter = jitter.to(field.device, non_blocking=True)
        with torch.set_grad_enabled(self.learning):
            occupancy = self.pipeline.occupancy
            how = self.rendering.sampling(occupancy.contracted)
            pixels, _ = render_batch(field, rays, occupancy, how, jitter=jitter)
            rendered = (  # in the order of `_to_render`
                (some, pixels.take(slice(end - len(some), end)))
                for some, end in zip(chosen, accumulate(map(len, chosen)), strict=True)
            )
            observations = [self._observation(patch, rendered) for patch in patches]
        return Batch(observations, torch.stack([patch.truth for patch in patches]), pixels.alpha)

    def _to_render(self, patch: Patch) -> Iterator[tuple[Camera, Tensor]]:
        """Cameras, and which of their pixels [h w] are rendered: of the present frame, those that
        may see matter; if the field learns, of the preceding frames those that the patch shows."""
        low, full = patch.view.low, patch.view.full
        yield low, sees_matter(low, self.pipeline.occupancy).flatten()
        if self.learning:
            for cloud, points in zip(patch.example.buffer, patch.points, strict=True):
                yield cloud.camera, points.pixel < full.width * full.height

    def _observation(self, patch: Patch, rendered: Rendered) -> Observation:
        """What the 2D renderer is shown of `patch`, of which pixels are as `rendered` now."""
        low, background = patch.view.low, self.pipeline.background
        seen, pixels = next(rendered)
        canvas = Pixels.blank(low.height * low.width, pixels.values.shape[1], seen.device)
        canvas.put(seen, pixels)
        frame = FeatureFrame.of(low, canvas, background)
        points = patch.points
        if self.learning:
            points = [_renewed(old, *next(rendered), background) for old in points]
        return Observation(replace(frame, depth=frame.depth.detach()), points)

    def state(self) -> Tensors:
        """All examples, to be kept in a file."""
        tensors = {}
        for place, example in enumerate(self._pool):
            tensors[f"{place}.figures"] = torch.tensor((example.number, example.uses))
            for age, cloud in enumerate(example.buffer):
                parts = {**vars(cloud), "camera": pack_camera(cloud.camera)}
                tensors |= {f"{place}.{age}.{name}": x for name, x in parts.items()}
        return tensors

    def restore(self, tensors: Tensors) -> None:
        """Restore the examples that `state` returned, with the same views and options."""
        self._pool = []
        device = self.pipeline.background.device
        while example := checkpoint.part(tensors, f"{len(self._pool)}."):
            number, uses = example["figures"].tolist()
            buffer = Buffer(maxlen=self.pipeline.model.frames)
            while cloud := checkpoint.part(example, f"{len(buffer)}."):
                camera = place_camera(unpack_camera(cloud.pop("camera")), device)
                parts = {name: x.to(device) for name, x in cloud.items()}
                buffer.append(PointCloud(camera, **parts))
            self._pool.append(Example(number, buffer, uses))


def _renewed(old: Points, seen: Tensor, pixels: Pixels, background: Tensor) -> Points:
    """Points whose features, of those at indices `seen`, are as rendered now."""
    return replace(old, values=old.values.index_copy(0, seen, pixels.over(background).values))

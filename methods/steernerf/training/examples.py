"""Training examples: a true picture, and the frames that came before it (Section 3.4).

Training views are scattered, so the preceding cameras are synthetic: a random smooth motion that
ends at the view. The pipeline renders these frames with its present weights, as it does when it is
used. After a number of patches they are rendered again, along another motion.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from bench.cameras import pack_camera, place_camera, unpack_camera
from bench.motion import preceding, viewing_target
from bench.types import Camera, Scene, Split
from methods.steernerf.buffer import Buffer, Cloud
from methods.steernerf.pipeline import Pipeline
from methods.steernerf.training.options import MotionOptions
from methods.training.checkpoint import part


@dataclass(frozen=True)
class TrainingViews:
    """The views of a scene that a 2D renderer learns from: the real ones, then distilled ones, with
    pictures that a trained field has rendered (Section 3.5)."""

    cameras: Sequence[Camera]
    pictures: Sequence[Tensor]  # uint8 [H, W, 3 or 4]
    real: int  # how many of them are real
    share: float  # share of the examples that end in a distilled view
    target: Tensor  # [3] the point that the cameras look at, roughly

    @classmethod
    def of(cls, scene: Scene, distilled: Split | None = None, share: float = 0.0) -> TrainingViews:
        """The training views of `scene`, and `distilled` ones for a `share` of the examples."""
        splits = [scene.splits["train"], *([distilled] if distilled else [])]
        cameras = [camera for split in splits for camera in split.cameras]
        pictures = [picture for split in splits for picture in split.images]
        real = len(splits[0].cameras)
        return cls(cameras, pictures, real, share, viewing_target(scene))


@dataclass
class Example:
    """A training view and the frames that precede it."""

    number: int  # of the view
    buffer: Buffer  # the preceding frames
    uses: int  # patches that may still be cut from it
    lasting: bool  # whether it is then continued instead of replaced


class ExamplePool:
    """Examples that end in randomly chosen `views` and are replaced as `MotionOptions` says; the
    frames that precede a view are rendered by `pipeline`, as `rendering` says."""

    def __init__(
        self,
        pipeline: Pipeline,
        rendering: Any,
        views: TrainingViews,
        options: MotionOptions,
        generator: torch.Generator,
    ) -> None:
        self.pipeline, self.rendering = pipeline, rendering
        self.views, self._options, self._generator = views, options, generator
        self._pool: list[Example] = []

    def draw(self) -> Example:
        """Draw an example from the pool; counts as one use."""
        place = min(self._random(self._options.pool), len(self._pool))
        old = self._pool[place] if place < len(self._pool) else None
        if old is None or old.uses <= 0:
            self._pool[place : place + 1] = [
                self._go_on(old) if old and old.lasting else self._make()
            ]
        self._pool[place].uses -= 1
        return self._pool[place]

    def _make(self) -> Example:
        views, real = self.views, self.views.real
        distilled = len(views.cameras) - real
        if self._chance() < (views.share if distilled else 0.0):
            number = real + self._random(distilled)
        else:
            number = self._random(real)
        buffer = Buffer(maxlen=self.pipeline.model.frames)
        return self._ended(number, self._motion(views.cameras[number]), buffer)

    def _go_on(self, old: Example) -> Example:
        """Continue from the view that `old` ends in, there and back."""
        camera = self.views.cameras[old.number]
        back = self._motion(camera)
        back = back[len(back) // 2 :]
        path = [camera, *reversed(back), *back[1:]]
        return self._ended(old.number, path, old.buffer.copy())

    def _motion(self, camera: Camera) -> list[Camera]:
        options = self._options
        count = options.least + self._random(options.length - options.least + 1)
        return preceding(camera, self.views.target, count, options.degrees, self._generator)

    def _ended(self, number: int, motion: Sequence[Camera], buffer: Buffer) -> Example:
        """Make an example after rendering the frames of a `motion` into its `buffer`."""
        if frames := self.pipeline.model.frames:
            for camera in motion:
                self.pipeline.remember(camera, buffer, self.rendering)
        # Without preceding frames, continuing would only repeat the view.
        lasting = self._chance() < self._options.longer and frames > 0
        return Example(number, buffer, self._options.uses, lasting)

    def _chance(self) -> float:
        return torch.rand((), generator=self._generator).item()

    def _random(self, below: int) -> int:
        return int(torch.randint(below, (), generator=self._generator))

    def state(self) -> dict[str, Tensor]:
        """The state of all examples, to be kept in a file."""
        tensors = {}
        for place, example in enumerate(self._pool):
            figures = (example.number, example.uses, example.lasting)
            tensors[f"{place}.figures"] = torch.tensor(figures)
            for age, cloud in enumerate(example.buffer):
                for name, x in vars(cloud).items():
                    packed = pack_camera(x) if isinstance(x, Camera) else x
                    tensors[f"{place}.{age}.{name}"] = packed
        return tensors

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Restore the examples that `state` of a pool with the same views and options returned."""
        count = sum(name.endswith(".figures") for name in tensors)
        self._pool = [self._restored(part(tensors, f"{place}.")) for place in range(count)]

    def _restored(self, tensors: Mapping[str, Tensor]) -> Example:
        number, uses, lasting = tensors["figures"].tolist()
        buffer = Buffer(maxlen=self.pipeline.model.frames)
        for age in range(sum(name.endswith(".points") for name in tensors)):
            buffer.append(self._unpacked(part(tensors, f"{age}.")))
        return Example(number, buffer, uses, bool(lasting))

    def _unpacked(self, tensors: Mapping[str, Tensor]) -> Cloud:
        device = self.pipeline.background.device
        parts: dict[str, Any] = {name: x.to(device) for name, x in tensors.items()}
        for name, x in tensors.items():
            if x.dtype == torch.float64:  # as nothing in a cloud but cameras
                parts[name] = place_camera(unpack_camera(x), device)
        return self.pipeline.kept(**parts)

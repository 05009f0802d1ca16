"""Training views with the frames before them, on which engines are built and compared."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from statistics import mean, median

import torch
from torch import Tensor

from bench.clock import FrameRecord, StageClock
from bench.metrics import psnr
from bench.motion import preceding, viewing_target
from bench.types import Camera, Frame, Log, NullProbe, Probe, Scene, composite
from methods.engines import Built
from methods.engines.auto import EngineFigures
from methods.steernerf.buffer import Buffer
from methods.steernerf.options import JointOptions, Rendering
from methods.steernerf.pipeline import Pipeline

COMPARED = 4
"""Number of views that engines are compared in."""


@dataclass(frozen=True)
class TrainingViews:
    """The training views of `scene`, rendered by `pipeline` as in training, whatever is chosen
    afterwards; `seed` is that of the motions before them."""

    pipeline: Pipeline
    scene: Scene
    joint: JointOptions
    seed: int
    log: Log

    def inputs(self, count: int) -> list[Tensor]:
        """The inputs of the network in `count` views, as an engine gets them: drawn whole."""
        renderer, recorded = self.pipeline.renderer, list[Tensor]()

        def record(inputs: Tensor) -> Tensor:
            recorded.append(inputs.clone())  # the next frame overwrites it
            return renderer.network(inputs)

        renderer.engine = None  # the network itself draws the frames before
        for _, camera, buffer in self._spread(count, "frames to build the network on"):
            renderer.engine = Built(record, 0)
            self._render(camera, buffer, NullProbe())
            renderer.engine = None
        return recorded

    def compare(self, networks: Sequence[Built]) -> list[EngineFigures]:
        """The PSNR of pictures and the time of the 2D renderer with each of the `networks`."""
        split, background = self.scene.splits["train"], self.pipeline.background
        clocks = [StageClock(str(background.device)) for _ in networks]
        quality = [list[float]() for _ in networks]
        for number, camera, buffer in self._spread(COMPARED, "frames to compare engines in"):
            truth = composite(split.images[number], self.scene.background)
            for network, clock, found in zip(networks, clocks, quality, strict=True):
                self.pipeline.renderer.engine = network
                self._render(camera, buffer, NullProbe())  # the first of its size takes longer
                with clock.frame():
                    frame = self._render(camera, buffer, clock)
                found.append(psnr(frame.rgb.cpu(), truth, split.mask(number)))
            self.pipeline.renderer.engine = None  # the network itself draws the frames before
        of_renderer = [[_renderer_ms(frame) for frame in clock.frames] for clock in clocks]
        of_each = zip(map(mean, quality), map(median, of_renderer), strict=True)
        return [EngineFigures(*figures) for figures in of_each]

    def _spread(self, count: int, label: str) -> Iterator[tuple[int, Camera, Buffer]]:
        """Numbers and cameras of `count` views, evenly spread, and the frames before each: L + 1 of
        a random motion, so that even the oldest in the buffer had a preceding one."""
        generator = torch.Generator().manual_seed(self.seed)
        cameras, target = self.scene.splits["train"].cameras, viewing_target(self.scene)
        frames, degrees = self.pipeline.model.frames, self.joint.motion.degrees
        with self.log.progress(label, count) as progress:
            for place in range(count):
                number, buffer = place * len(cameras) // count, Buffer(maxlen=frames)
                camera = cameras[number]
                for before in preceding(camera, target, frames + 1, degrees, generator):
                    self.pipeline.remember(before, buffer, self._rendering)
                yield number, camera, buffer
                progress.advance()

    def _render(self, camera: Camera, buffer: Buffer, probe: Probe) -> Frame:
        """The frame that follows those in `buffer`, which stays as it is."""
        return self.pipeline.render(camera, buffer.copy(), self._rendering, probe)

    @property
    def _rendering(self) -> Rendering:
        return self.joint.rendering(self.pipeline.model)


def _renderer_ms(frame: FrameRecord) -> float:
    """The time of the 2D renderer, with its network."""
    return sum(ns for name, ns in frame.stages_ns.items() if name.startswith("renderer2d")) / 1e6

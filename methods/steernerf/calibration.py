"""Inputs of the 2D renderer's network on real frames, for engines that calibrate on them."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import torch

from bench.motion import preceding, viewing_target
from bench.sharing import missing
from bench.types import Log, NullProbe, Scene
from methods.engines import Inputs
from methods.steernerf.buffer import Buffer
from methods.steernerf.pipeline import Pipeline
from methods.training import checkpoint


@dataclass(frozen=True)
class Calibration:
    """Frames of a trained pipeline on which an engine can calibrate the network.

    Attributes:
        pipeline: the trained pipeline; its renderer has no engine yet.
        rendering: how the frames are rendered.
        scene: the scene whose training views are rendered.
        degrees: range of the angular speed of the motion before each view, in degrees per frame.
        seed: seed of these motions.
    """

    pipeline: Pipeline
    rendering: Any
    scene: Scene
    degrees: tuple[float, float]
    seed: int

    def inputs(self, count: int, folder: Path, log: Log) -> list[Inputs]:
        """The network's inputs in `count` frames, 1 or more; recorded once and kept in `folder`.

        Raises:
            SteerbenchError: the file in `folder` cannot be written or read.
        """
        path = folder / "inputs.safetensors"
        with missing(path, log) as to_record:
            if to_record:
                frames = enumerate(self.record(count, log))
                named = {f"{n:03} {place}": x for n, xs in frames for place, x in enumerate(xs)}
                checkpoint.write(path, named, {})
        tensors, _ = checkpoint.read(path)
        device = self.pipeline.background.device
        by_frame = groupby(sorted(tensors), lambda name: name.partition(" ")[0])
        return [tuple(tensors[name].to(device) for name in names) for _, names in by_frame]

    def record(self, count: int, log: Log) -> list[Inputs]:
        """Record the network's inputs in `count` training views, evenly spread.

        L + 1 frames of a random smooth motion precede each view. That is one more than the buffer
        holds, so that even its oldest frame was rendered with a preceding frame.
        """
        generator = torch.Generator().manual_seed(self.seed)
        cameras, target = self.scene.splits["train"].cameras, viewing_target(self.scene)
        pipeline, length = self.pipeline, self.pipeline.model.frames
        frames: list[Inputs] = []
        with log.progress("frames to build the network on", count) as progress:
            for place in range(count):
                camera = cameras[place * len(cameras) // count]
                buffer = Buffer(maxlen=length)
                for before in preceding(camera, target, length + 1, self.degrees, generator):
                    pipeline.remember(before, buffer, self.rendering)
                network = pipeline.renderer.network
                with network.register_forward_pre_hook(lambda _, xs: frames.append(xs)):
                    pipeline.render(camera, buffer, self.rendering, NullProbe())
                progress.advance()
        return frames

"""Inputs of a 2D renderer's network on real frames, for engines that have to see some."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import groupby
from pathlib import Path

import torch
from torch import Tensor

from bench.motion import preceding
from bench.sharing import missing
from bench.types import Log, NullProbe, Scene
from methods.engines import Inputs
from methods.steernerf.buffer import RenderingBuffer
from methods.steernerf.pipeline import Pipeline
from methods.steernerf.training.sequences import MotionOptions
from methods.training import checkpoint


def kept_inputs(
    folder: Callable[[], Path],
    record: Callable[[], Sequence[Inputs]],
    device: torch.device,
    log: Log,
) -> list[Inputs]:
    """What `record` finds on `device`: done once, and kept in `folder` for every engine that is to
    see it.

    Raises:
        SteerbenchError: the file there cannot be written or read.
    """
    path = folder() / "inputs.safetensors"
    with missing(path, log) as to_record:
        if to_record:
            frames = record()
            tensors = {
                f"{frame:03} {place}": x
                for frame, inputs in enumerate(frames)
                for place, x in enumerate(inputs)
            }
            checkpoint.write(path, tensors, {})
            return list(frames)
    log.info(f"frames to build the network on: found in {path}")
    tensors, _ = checkpoint.read(path)
    by_frame = groupby(sorted(tensors), lambda name: name.partition(" ")[0])
    return [tuple(tensors[name].to(device) for name in names) for _, names in by_frame]


def recorded_inputs(
    pipeline: Pipeline,
    scene: Scene,
    target: Tensor,
    count: int,
    motion: MotionOptions,
    seed: int,
    log: Log,
) -> list[Inputs]:
    """What the network is given in `count` training views of `scene`, evenly spread.

    Each view ends a random smooth motion, as in `methods.steernerf.training.sequences`, of as many frames as the
    buffer holds and one more.

    Args:
        target: [3] the point that motions turn about.
        count: of views, 1 or more.
        motion: says how fast the motions turn.
        seed: of the motions.
    """
    generator = torch.Generator().manual_seed(seed)
    cameras = scene.splits["train"].cameras
    renderer, seen = pipeline.renderer, []

    def record(*inputs: Tensor) -> Inputs:
        seen.append(inputs)
        return renderer.network(*inputs)

    renderer.engine, frames = record, []
    try:
        with log.progress("frames to build the network on", count) as progress:
            for place in range(count):
                camera = cameras[place * len(cameras) // count]
                buffer = RenderingBuffer(pipeline.options.frames)
                before = pipeline.options.frames + 1
                for earlier in preceding(camera, target, before, motion.degrees, generator):
                    pipeline.render(earlier, buffer, NullProbe())
                pipeline.render(camera, buffer, NullProbe())
                frames.append(seen[-1])
                seen.clear()
                progress.advance()
    finally:
        renderer.engine = None
    return frames
